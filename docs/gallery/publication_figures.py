"""The publication's figures from one test, by name, each as a small picture.

Run: python docs/gallery/publication_figures.py [FOLDER]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import xarray as xr
from matplotlib.figure import Figure
from matplotlib.image import imread

import vision
from vision.experiment import preset, simulate, with_settings
from vision.figures import FIGURES
from vision.pipeline import Settings

NAMES = (
    "force_insets",
    "sticks",
    "force_drop",
    "stiffness",
    "frame",
    "single_sheets",
    "stick",
    "mean_deformation",
    "intensity",
)
sample = Path(__file__).parents[2] / "fixtures" / "paper"
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path()
folder.mkdir(parents=True, exist_ok=True)

# Five seconds hold too few slips to align the clocks by, so the offset is given.
settings = Settings(
    pixel_size_um=10,
    timestamps=sample / "timestamps.txt",
    d0_mm=13,
    offset_s=float(xr.load_dataset(sample / "truth.nc").attrs["offset_s"]),
)
run = vision.analyse(sample / "video.avi", sample / "force.txt", settings)

# A mean over a dozen sticks around several separations needs half a pull: here at 5 mm/min, small and sharp.
changes = {"mechanics.speed_mm_min": 5, "camera.fps": 40, "camera.duration_s": 30, "clocks.offset_s": 1}
changes |= {"camera.width": 640, "camera.height": 24, "sheets.pitch_px": 12, "optics.fwhm_px": 6}
changes |= {"sheets.bow_px": 0, "optics.tilt_deg": 0, "clocks.force_rate_Hz": 500, "load_cell.lowpass_s": 0}
with TemporaryDirectory() as scratch:
    made = simulate(with_settings(preset("paper"), changes), Path(scratch) / "pull")
    known = Settings(pixel_size_um=10, timestamps=made.timestamps, d0_mm=13, offset_s=1)
    pull = vision.analyse(made.video, made.force, known)

sheet = Figure(figsize=(13, 11), layout="constrained")
for place, name in enumerate(NAMES, 1):
    figure = FIGURES[name].make(pull if name == "mean_deformation" else run)
    picture = figure.save(folder / f"{name}.png", dpi=60)  # or .pdf, .svg; .csv holds the numbers
    ax = sheet.add_subplot(3, 3, place)
    ax.imshow(imread(picture))
    ax.set_title(f"figure {FIGURES[name].paper}: {name}", loc="left", fontsize=9)
    ax.axis("off")
sheet.savefig(folder / "publication_figures.png", dpi=80)
