"""How far each sheet creeps in each stick, in px, with its error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vision.deformation.creep import Creep, fit_creep, mean_square
from vision.deformation.drift import BothSides
from vision.deformation.ends import Ends, find_ends
from vision.deformation.errors import Errors
from vision.deformation.frames import Bools, Doubles, Ints, StickFrames
from vision.deformation.locking import let_go
from vision.deformation.memory import Memory, inflation
from vision.deformation.noise import Noise, measure_noise
from vision.deformation.one_side import OneSide
from vision.deformation.pattern import pattern_px
from vision.deformation.vibration import noise_regained, shaking

_SCALE = 0.002  # of the creep: bowed sheets and the lens magnify unequally over the view
_CURVED = 3.0  # standard errors by which a parabola must differ from a line
_MANY_FRAMES = 12  # a stick from which noise is told from creep by a cubic, else by a parabola
_LEAST_CURVED = 6  # positions for a parabola to be tried


@dataclass(frozen=True)
class Amplitude:
    """Creep of every sheet in every stick, (stick, sheet), px; NaN where `good` is False.

    raw_px: RMS over the usable frames as they are.
    signed_px: RMS over the whole stick, positive where the sheet goes inwards, with error_px.  sweep_px:
    inward movement over the stick.  middle_px: x̂.  count: positions used.  uneven: residuals stand out.
    effective_frames, drift_px: (stick,).  noise_px: (sheet,).  camera: which of its movements are taken off.
    """

    raw_px: Doubles
    signed_px: Doubles
    error_px: Doubles
    sweep_px: Doubles
    middle_px: Doubles
    count: Ints
    good: Bools
    uneven: Bools
    effective_frames: Doubles
    drift_px: Doubles
    noise_px: Doubles
    memory: Memory
    camera: str = "not taken off"


@dataclass(frozen=True)
class Sheets:
    """What is known of the sheets, (sheet,): side, n, and the predicted error of a position, px, NaN if none.

    pull: towards whole pixels, see `locking`.  pixels: whether positions come from a picture, so that unequal
    pixels are among their errors.
    """

    side: Ints
    n: Ints
    predicted_px: Doubles
    pull: Doubles
    pixels: bool


def measure_amplitude(
    x_px: Doubles, frames: StickFrames, sheets: Sheets, *, common_mode: bool = True
) -> Amplitude:
    """Creep from the positions in usable frames, x_px (F, sheet), NaN where there is none.

    common_mode: whether to take the camera's movement off.
    """
    terms = 4 if np.median(frames.counts) >= _MANY_FRAMES else 3
    freed = let_go(x_px, sheets.pull, frames, terms)
    shake, regained = _shaking(freed, frames, terms, common_mode)
    steady = freed - shake[:, None]
    ends = find_ends(steady, frames)
    steady = np.where(ends.outside, np.nan, steady)
    line, parabola, close = (fit_creep(steady, frames, terms=k) for k in (2, 3, terms))
    noise = measure_noise(steady - close.at(frames), close, frames, sheets.predicted_px)
    noise = replace(noise, noise_px=noise.noise_px * np.sqrt(regained))
    errors = Errors(noise, np.zeros(sheets.n.size), frames)
    if sheets.pixels:
        errors = replace(errors, pattern_px=pattern_px(close, errors.of(close), noise), scale=_SCALE)
    camera = _camera(line, frames, sheets, shake) if common_mode else None
    creep = _choose(line, parabola, errors, camera).shortened(ends)
    found = _amplitude(creep, line, noise, frames, np.sqrt(mean_square(x_px, frames)), sheets.side)
    return replace(found, camera=camera.movement) if camera else found


def _camera(line: Creep, frames: StickFrames, sheets: Sheets, shake: Doubles) -> BothSides | OneSide:
    both = BothSides.of(sheets.side, sheets.n, line.coefficient[..., 0], line.coefficient[..., 1])
    return both if both.enough else OneSide.of(line, sheets.n, frames, shake)


def _amplitude(
    creep: _Chosen,
    line: Creep,
    noise: Noise,
    frames: StickFrames,
    raw_px: Doubles,
    side: Ints,
) -> Amplitude:
    square = creep.slope**2 / 3 + np.where(creep.bend == 0, 0.0, creep.bend**2 - creep.bend_err**2) / 5
    return Amplitude(
        raw_px=np.where(line.good, raw_px, np.nan),
        signed_px=np.asarray(-side * np.sign(creep.slope) * np.sqrt(square), float),
        error_px=_root_error(creep, square),
        sweep_px=-2 * side * creep.straight,
        middle_px=creep.middle,
        count=line.count,
        good=line.good,
        uneven=noise.excess > 1,
        effective_frames=frames.counts / inflation(noise.memory, frames, 2)[:, 1],
        drift_px=2 * creep.drift,
        noise_px=noise.noise_px,
        memory=noise.memory,
    )


def _shaking(x_px: Doubles, frames: StickFrames, terms: int, common_mode: bool) -> tuple[Doubles, Doubles]:
    """The camera's vibration in each frame, and what taking it off does to each sheet's noise variance."""
    if not common_mode:
        return np.zeros(len(x_px)), np.ones(x_px.shape[1])
    residual = x_px - fit_creep(x_px, frames, terms=terms).at(frames)
    return shaking(residual), noise_regained(residual)


@dataclass(frozen=True)
class _Chosen:
    """Line or parabola, whichever each sheet asks for, (stick, sheet), without drift, (stick,).

    x = middle + slope u + bend P2(u); bend is 0 for a line.  straight: the line's slope in any case.
    """

    middle: Doubles
    slope: Doubles
    slope_err: Doubles
    bend: Doubles
    bend_err: Doubles
    straight: Doubles
    drift: Doubles

    def shortened(self, ends: Ends) -> _Chosen:
        """For sheets that creep for less than the whole stick."""
        part = 1 - ends.lost
        return replace(
            self,
            slope=self.slope * part,
            slope_err=np.hypot(self.slope_err, self.slope * ends.lost_err),
            bend=self.bend * part,
            straight=self.straight * part,
        )


def _choose(line: Creep, parabola: Creep, errors: Errors, camera: BothSides | OneSide | None) -> _Chosen:
    bent_err, line_err = errors.of(parabola), errors.of(line)
    bend, bend_err, _ = _moved(camera, parabola.coefficient[..., 2], bent_err[..., 2], slow=False)
    curved = (parabola.count >= _LEAST_CURVED) & (np.abs(bend) > _CURVED * bend_err)
    best = np.where(curved[..., None], parabola.coefficient[..., :2], line.coefficient)
    best_err = np.where(curved, bent_err[..., 1], line_err[..., 1])
    slope, slope_err, _ = _moved(camera, best[..., 1], best_err)
    straight, _, drift_px = _moved(camera, line.coefficient[..., 1], line_err[..., 1])
    bend = np.where(curved, bend, 0.0)
    return _Chosen(best[..., 0], slope, slope_err, bend, bend_err, straight, drift_px)


def _root_error(creep: _Chosen, square: Doubles) -> Doubles:
    """Error of √(slope²/3 + bend²/5) to first order."""
    spread = np.hypot(creep.slope / 3 * creep.slope_err, creep.bend / 5 * creep.bend_err)
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = spread / np.sqrt(square)
    return np.where(creep.bend == 0, creep.slope_err / np.sqrt(3), curved)


def _moved(
    camera: BothSides | OneSide | None, value: Doubles, error: Doubles, *, slow: bool = True
) -> tuple[Doubles, Doubles, Doubles]:
    """The coefficient without the camera's movement, its error with that of the movement, and the movement,
    (stick,)."""
    if camera is None:
        return value, error, np.zeros(len(value))
    drift = camera.drift(value, error, slow=slow)
    return value - drift.value[:, None], drift.error_without(error), drift.value
