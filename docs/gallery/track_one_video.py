"""Track one video: from the file to x(n, t), and a picture to judge it by.

Run: python docs/gallery/track_one_video.py [FOLDER]
"""

import sys
from pathlib import Path

from matplotlib.figure import Figure

import vision
from vision.figures import kymograph_figure, space_time_figure, tracks_figure

PIXEL_SIZE_UM = 10.0
recording = Path(__file__).parents[2] / "fixtures" / "paper" / "video.avi"
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path()
folder.mkdir(parents=True, exist_ok=True)

# The camera's rate must be given: an AVI file holds only the rate at which it is played.
video = vision.open_video(recording, fps=60)
strip = vision.strip_profile(video)  # I(x, t); the strip of rows is found
tracks = vision.track_sheets(strip)  # x_px, x_err_px and flag (frame, sheet)
outermost = vision.space_time(
    strip, around=tracks, sheet=("right", 25), width_um=200, pixel_size_um=PIXEL_SIZE_UM
)

figure = Figure(figsize=(11, 12), layout="constrained")
top, motion, one = figure.subplots(3, 1)
space_time_figure(strip, tracks, pixel_size_um=PIXEL_SIZE_UM).plot(top)
tracks_figure(tracks, pixel_size_um=PIXEL_SIZE_UM).plot(motion)
kymograph_figure([outermost]).plot(one)
one.set_title("Sheet n = 25 on the right at native resolution: creep and slips", loc="left")
figure.savefig(folder / "track_one_video.png", dpi=110)
