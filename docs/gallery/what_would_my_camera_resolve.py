"""What would my camera resolve? The same test seen by two cameras, before either is bought.

Run: python docs/gallery/what_would_my_camera_resolve.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import vision
from vision.experiment import preset, profiles, with_settings

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path()
folder.mkdir(parents=True, exist_ok=True)

test = with_settings(preset("paper"), {"camera.duration_s": 3})
# half the pixels over the same 19.2 mm, so every length in pixels is halved, and less light per pixel
coarse = {
    "camera.width": 960,
    "camera.height": 50,
    "camera.strip_rows": 42,
    "camera.pixel_size_um": 20,
    "camera.full_well_e": 2500,
    "sheets.pitch_px": 10,
    "sheets.bow_px": 0.5,
    "optics.fwhm_px": 4,
    "optics.texture_px": 3,
    "optics.drift_px": 0.25,
    "optics.vibration_px": 0.025,
}
cameras = {
    "10 µm/px, full well 10 500 e⁻": test,
    "20 µm/px, full well 2 500 e⁻": with_settings(test, coarse),
}

figure = Figure(figsize=(11, 5), layout="constrained")
ax = figure.subplots()
for (name, camera), mark in zip(cameras.items(), ("o", "s"), strict=True):
    strip, truth = profiles(camera)  # I(x, t) as from a video, and what is true
    tracks = vision.track_sheets(strip, sheets=50, axis_px=truth.attrs["axis_px"])
    um = camera.camera.pixel_size_um
    noise_um = tracks["x_noise_px"] * um  # as measured from frame to frame, without the truth
    error_um = (tracks["x_px"] - truth["x_px"].values).std("frame") * um  # what only the truth can tell
    (dots,) = ax.plot(tracks["side"] * tracks["n"], noise_um, mark, label=f"{name}: measured noise")
    ax.plot(tracks["side"] * tracks["n"], error_um, color=dots.get_color(), label="  error against the truth")

limit_um = 0.1 * float(np.nanmedian(truth["stick_length_um"]))
name = rf"$\sigma_x$ at the threshold, $\Lambda_{{st}}$/10 = {limit_um:.1f} µm"
ax.axhline(limit_um, color="0.4", ls="--", label=name)
ax.set(xlabel="sheet, side × n", ylabel="σ of a position (µm)", ylim=(0, None))
ax.set_title("Noise of every sheet's position in one frame, two cameras on the same test", loc="left")
ax.legend(loc="lower right", bbox_to_anchor=(1, 1.06), ncols=3, fontsize=8, frameon=False)
figure.savefig(folder / "what_would_my_camera_resolve.png", dpi=110)
