"""Short films and tables for campaigns."""

import os

from tests.scenes.comb_video import frames_of, positions, write_video
from vision.campaign.films import Row
from vision.campaign.plan import make_plan, write_plan


def films(folder, count, frames=30):
    """So many short films t0.tif, t1.tif …, each of its own noise."""
    folder.mkdir(exist_ok=True)
    return [write_video(folder / f"t{k}.tif", frames_of(positions(frames), seed=k)) for k in range(count)]


def table(path, names, **columns):
    """A table of films; further columns hold one value for all or a list."""
    heads = ["film", *columns]
    lines = [",".join(heads)]
    for k, name in enumerate(names):
        cells = [value[k] if isinstance(value, list) else value for value in columns.values()]
        lines.append(",".join([str(name), *map(str, cells)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rows(paths, **values):
    """Rows as the table gives them, with options that are already checked."""
    return [
        Row(row=k + 2, film=str(path), name=path.stem, values=values, facts={"sample": "old"})
        for k, path in enumerate(paths)
    ]


def planned(out, paths, **values):
    """A written plan of these films."""
    plan = make_plan(rows(paths, **values), out, cores=1)
    write_plan(plan)
    return plan


def environment(folder):
    """Of a process that runs this checkout."""
    return os.environ | {"PYTHONPATH": str(folder), "PYTHONWARNINGS": "ignore"}
