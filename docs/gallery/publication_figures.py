"""The publication's figures from one test, by name, each as a small picture.

Run: python docs/gallery/publication_figures.py [FOLDER]
"""

import sys
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure
from matplotlib.image import imread

import vision
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

# Five seconds hold too few slips to align the clocks by, so the offset is given.
settings = Settings(
    pixel_size_um=10,
    timestamps=sample / "timestamps.txt",
    d0_mm=13,
    offset_s=float(xr.load_dataset(sample / "truth.nc").attrs["offset_s"]),
)
run = vision.analyse(sample / "video.avi", sample / "force.txt", settings)

sheet = Figure(figsize=(13, 11), layout="constrained")
for place, name in enumerate(NAMES, 1):
    figure = FIGURES[name].make(run)
    picture = figure.save(folder / f"{name}.png", dpi=60)  # or .pdf, .svg; .csv holds the numbers
    ax = sheet.add_subplot(3, 3, place)
    ax.imshow(imread(picture))
    ax.set_title(f"figure {FIGURES[name].paper}: {name}", loc="left", fontsize=9)
    ax.axis("off")
sheet.savefig(folder / "publication_figures.png", dpi=80)
