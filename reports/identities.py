"""How many of a million positions that are called ok are wrong, in degraded films of unused seeds.

Run from the checkout: python -m reports.identities
Writes reports/identities.md.
"""

from __future__ import annotations

import itertools
import tempfile
from collections import defaultdict
from pathlib import Path

from reports.writing import head, row, write_report
from tests.scenes.degraded import CODECS, DEGRADATIONS, FRAMES, SHEETS, WIDTH, clean, measured
from vision.errors import InputError

POSITIONS = 1_000_000
FIRST_SEED = 1001


def main() -> None:
    """Track every degradation through every codec, each with a new seed, until there are enough positions."""
    films: dict[str, int] = defaultdict(int)
    called_ok: dict[str, int] = defaultdict(int)
    wrong: dict[str, int] = defaultdict(int)
    refused: list[str] = []
    seeds = itertools.count(FIRST_SEED)
    while sum(called_ok.values()) < POSITIONS:
        for codec, (name, make) in itertools.product(CODECS, DEGRADATIONS.items()):
            seed = next(seeds)
            clean.cache_clear()  # no film is needed twice
            with tempfile.TemporaryDirectory() as folder:
                try:
                    found = measured(make(seed), Path(folder), codec)
                except InputError as error:
                    refused.append(f"{name}, {codec}, seed {seed}: {str(error).replace(folder, '')}")
                    continue
            films[name] += 1
            called_ok[name] += round(found.found * found.positions) + found.wrong
            wrong[name] += found.wrong
            if found.wrong:
                print(f"{name}, {codec}, seed {seed}: {found.wrong} wrong", flush=True)
    counts = (films, called_ok, wrong)
    lines = [
        "# Identities of a million positions",
        "",
        f"Degraded films as in degraded.md ({FRAMES} frames {WIDTH} px wide with {SHEETS} sheets), every",
        f"degradation through each of {len(CODECS)} codecs and qualities, each film of a seed of its own",
        f"({FIRST_SEED} and on), tracked without any option. Wrong: called ok and more than half a pitch",
        "off, or a sheet reported twice. Wanted: 0.",
        "",
        *head(["film", "films", "positions called ok", "wrong"]),
        *(row([name, *(one[name] for one in counts)]) for name in films),
        row(["all", *(sum(one.values()) for one in counts)]),
        *(["", *(f"Refused: {line}." for line in refused)] if refused else []),
    ]
    write_report("identities", lines)


if __name__ == "__main__":
    main()
