"""The publication's figures from several tests and from single sheets, each as a small picture.

Run: python docs/gallery/several_tests.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.image import imread

from vision.command.main import run
from vision.experiment import force_recording, preset, simulate_pull, with_settings, write_force
from vision.figures import load_figures

FIXTURES = Path(__file__).parents[2] / "fixtures"
NAMES = {"peaks": 3, "sticks": 4, "drops": 5, "stiffnesses": 6, "collapse": 9, "friction": 10, "modulus": 11}
NAMES |= {"trends": 14}
# V in mm/min, previous tests, relative humidity in %: N̂ rises with the tests, μ with humidity.
TESTS = ((0.5, 10, 40), (1, 11, 42), (5, 12, 41), (10, 13, 40), (1, 20, 52), (1, 28, 31))
folder = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else Path.cwd()
folder.mkdir(parents=True, exist_ok=True)

with tempfile.TemporaryDirectory() as scratch:
    work = Path(scratch)
    table = ["run,sample,V_mm_min,n_test,RH_percent"]
    for k, (speed, n_test, humidity) in enumerate(TESTS):
        changes = {
            "mechanics.speed_mm_min": speed,
            "mechanics.mu": 0.89 + 0.002 * (humidity - 40),
            "mechanics.n_hat_N": 0.57 + 0.008 * (n_test - 11),
            "mechanics.buildup_mm": 0.05,
            "mechanics.early_stiffness_ratio": 1.6 if speed > 1 else 1.0,
            "clocks.force_rate_Hz": 100 * speed,
            "clocks.offset_s": 1.0,
            "camera.duration_s": 1.0,
            "load_cell.lowpass_s": 0.0,
        }
        test = with_settings(preset("paper", seed=k), changes)
        pull = simulate_pull(test.mechanics, seed=k)
        file = work / f"test{k + 1}.txt"
        write_force(file, force_recording(test, pull), test.force_file)
        run(["force", str(file), "--d0", "13.0±0", "--out", str(work / file.stem), "--quiet"])
        table.append(f"{file.stem},{'AB'[k > 3]},{speed},{n_test},{humidity}")
    (work / "tests.csv").write_text("\n".join(table) + "\n", encoding="utf-8")
    compared = str(work / "comparison")
    run(["compare", "--table", str(work / "tests.csv"), "--out", compared, "--no-report", "--quiet"])

    run(["friction", str(FIXTURES / "discs.csv"), "--out", str(work / "friction"), "--quiet"])
    run(["modulus", str(FIXTURES / "strip.txt"), "--out", str(work / "modulus"), "--quiet"])

    # As `track figures comparison` and `track figures friction` give them.
    made = [
        figure
        for one in ("comparison", "friction", "modulus")
        for figure in load_figures(work / one / "figures.npz")
        if figure.name in NAMES
    ]
    sheet = Figure(figsize=(13, 13), layout="constrained")
    for place, figure in enumerate(made, 1):
        ax = sheet.add_subplot(4, 2, place)
        ax.imshow(imread(figure.save(folder / f"{figure.name}.png", dpi=60)))
        ax.set_title(f"figure {NAMES[figure.name]}: {figure.name}", loc="left", fontsize=9)
        ax.axis("off")
    sheet.savefig(folder / "several_tests.png", dpi=80)
