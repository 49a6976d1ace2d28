"""With the force: stick phases, both clocks, σ_x/Λ_st of every sheet and the stiff shell.

Run: python docs/gallery/with_force.py [FOLDER]
"""

import sys
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

import vision
from vision.figures import clocks_figure, deformation_figure, force_figure, shells_figure

PIXEL_SIZE_UM = 10.0
sample = Path(__file__).parents[2] / "fixtures" / "paper"
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path()
folder.mkdir(parents=True, exist_ok=True)

strip = vision.strip_profile(vision.open_video(sample / "video.avi", fps=60))
tracks = vision.track_sheets(strip)

force = vision.read_force(sample / "force.txt", d0_mm=13)  # load_N and d_mm (time_s)
sticks = vision.find_stick_slip(force)  # one row per stick-slip event
fits = vision.fit_models(force, sticks)  # Eq. 1, amplitude and stiffness, from the force alone

# Five seconds hold too few slips to align the clocks by, so the offset is given. For a longer video leave
# it out: the slips that camera and machine both saw decide.
offset_s = float(xr.load_dataset(sample / "truth.nc").attrs["offset_s"])
clock = vision.synchronise(tracks, force, sticks, offset_s=offset_s)

motion = vision.horizontal_deformation(tracks, sticks, clock, pixel_size_um=PIXEL_SIZE_UM)
shells = vision.classify_shells(motion, threshold=0.1, effective_sheets=fits.effective_sheets)

figure = Figure(figsize=(13, 9), layout="constrained")
(pull, clocks), (ratio, shell) = figure.subplots(2, 2)
force_figure(force, sticks, fits).plot(pull)
clocks_figure(force, tracks, clock, sticks, pixel_size_um=PIXEL_SIZE_UM).plot(clocks)
deformation_figure(motion, threshold=0.1).plot(ratio)
shells_figure(shells, fits).plot(shell)
titles = "The pull", "Force and sheets on one clock", "Deformation of every sheet", "Size of the stiff shell"
for ax, title in zip((pull, clocks, ratio, shell), titles, strict=True):
    ax.set_title(title, loc="left")
figure.savefig(folder / "with_force.png", dpi=110)
