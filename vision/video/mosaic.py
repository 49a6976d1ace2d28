"""Columns that are brighter and darker in turn, as below a Bayer pattern of colour filters saved as grey.

The comb that such columns draw over the sheets hides ridges, shifts their positions within the pixel, and
looks like a reflection. It is measured in I(x, t) and divided out.
"""

from __future__ import annotations

import numpy as np

from vision.mapped import parts_in_turn, some_rows
from vision.numeric import Bools, Floats32, spread_indices
from vision.video.settings import VideoSettings

_FRAMES = 200  # spread over the film, of which the mean is taken
_PARTS = 8  # of the columns, which must agree


def equalise_columns(intensity: Floats32, usable: Bools, settings: VideoSettings = VideoSettings()) -> float:
    r"""Divide I(x, t) by the gain of its columns, in place, and return by how much it differs; 0 for none.

    With the light L(x), smooth from pixel to pixel, and columns that are brighter and darker in turn,

    .. math:: I(x) = L(x)\,\bigl(1 + (-1)^x a\bigr), \qquad
        a = \frac{\sum (-1)^x \left(I(x) - \tfrac12 I(x-1) - \tfrac12 I(x+1)\right)}{2 \sum I(x)} .

    The gain is corrected if the mean a of eight parts of the columns exceeds `settings.column_gain` and
    `settings.column_sigmas` times its standard error: sharp ridges contribute by chance, with another sign in
    each part. Sheets and gaps of different colours have different gains, of which this is the mean.

    Parameters
    ----------
    intensity
        (frame, x), grey levels; NaN in unusable frames.
    usable
        Which frames show something, (frame,).
    settings
        Thresholds.

    Returns
    -------
    float
        Difference between neighbouring columns over their mean, 2|a|.
    """
    frames = np.flatnonzero(usable)
    if not frames.size or intensity.shape[1] < 4 * _PARTS:
        return 0.0
    mean = some_rows(intensity, frames[spread_indices(frames.size, _FRAMES)]).mean(axis=0, dtype=np.float64)
    sign = 1.0 - 2.0 * (np.arange(mean.size) % 2)
    beside = 0.5 * (mean[:-2] + mean[2:])
    parts = (
        [part.sum() for part in np.array_split(values, _PARTS)]
        for values in (sign[1:-1] * (mean[1:-1] - beside), mean[1:-1] + beside)
    )
    change, level = (np.array(part) for part in parts)
    if not (level > 0).all():
        return 0.0
    gains = change / level
    gain, error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(_PARTS))
    if not abs(gain) > max(settings.column_gain, settings.column_sigmas * error):
        return 0.0
    factor = (1 / (1 + sign * gain)).astype(np.float32)
    for rows in parts_in_turn(intensity):
        intensity[rows] *= factor
    return 2 * abs(gain)
