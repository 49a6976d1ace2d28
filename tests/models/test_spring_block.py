"""Spring and block: closed forms against the integrated motion, and the publication's slow limit."""

import numpy as np
import pytest

from vision.errors import InputError
from vision.models.spring_block import (
    SpringBlock,
    integrate_motion,
    slow_speed_limit_mm_s,
    slow_stick_slip,
    stick_slip,
)

BLOCK = SpringBlock(mass_kg=2.0, stiffness_N_per_mm=50.0, load_N=30.0, mu_static=0.6, mu_dynamic=0.45)


@pytest.mark.parametrize("ratio", [0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("mu_dynamic", [0.0, 0.25, 0.45], ids=["no-friction", "springs-back", "mild"])
def test_closed_forms_follow_from_the_equation_of_motion(ratio: float, mu_dynamic: float) -> None:
    """A failure means t_st, t_sl, u0, Δf or Λ_sl is not that of m ü = −k u + μ_d w."""
    block = SpringBlock(
        mass_kg=2.0, stiffness_N_per_mm=50.0, load_N=30.0, mu_static=0.6, mu_dynamic=mu_dynamic
    )
    speed = ratio * block.critical_speed_mm_s
    exact, motion = stick_slip(block, speed), integrate_motion(block, speed)
    slip = (motion["slip_end_s"] - motion["slip_start_s"]).values
    assert slip == pytest.approx(float(exact.slip_time_s), rel=1e-9)
    assert motion["lowest_elongation_mm"].values == pytest.approx(float(exact.lowest_elongation_mm), rel=1e-8)
    stick = motion["slip_start_s"].values[1:] - motion["slip_end_s"].values[:-1]
    assert stick == pytest.approx(float(exact.stick_time_s), rel=1e-8)
    assert speed * slip == pytest.approx(float(exact.slip_length_mm), rel=1e-9)
    drop = 50 * (motion["highest_elongation_mm"] - motion["lowest_elongation_mm"]).values
    assert drop == pytest.approx(float(exact.force_drop_N), rel=1e-8)


def test_the_block_rests_in_sticks_and_moves_forwards_in_slips() -> None:
    """A failure means phases are mixed up or the block is let slide backwards."""
    motion = integrate_motion(BLOCK, 0.5 * BLOCK.critical_speed_mm_s)
    speed = motion["block_speed_mm_s"].values
    sliding = motion["sliding"].values
    scale = BLOCK.critical_speed_mm_s
    assert np.abs(speed[~sliding]).max() < 1e-9 * scale
    assert speed[sliding].min() > -1e-8 * scale
    assert speed[sliding].max() > scale
    assert (np.diff(motion["time_s"].values) >= 0).all()


@pytest.mark.parametrize(("ratio", "percent"), [(0.1, 6), (1.0, 33), (5.0, 47)])
def test_how_short_the_slow_limit_is(ratio: float, percent: int) -> None:
    """6 % short at v/v_c = 0.1, 33 % at 1, 47 % at 5."""
    speed = ratio * BLOCK.critical_speed_mm_s
    short = 1 - slow_stick_slip(BLOCK, speed).slip_time_s / stick_slip(BLOCK, speed).slip_time_s
    assert round(100 * float(short)) == percent


def test_only_the_slip_time_depends_on_the_limit() -> None:
    """u0, Δf and t_st are exact at every speed: the slow limit must have the same."""
    speeds = BLOCK.critical_speed_mm_s * np.array([0.01, 1.0, 5.0])
    exact, slow = stick_slip(BLOCK, speeds), slow_stick_slip(BLOCK, speeds)
    for name in ("stick_time_s", "lowest_elongation_mm", "highest_elongation_mm", "force_drop_N"):
        np.testing.assert_array_equal(getattr(exact, name), getattr(slow, name))
    assert (exact.slip_time_s > slow.slip_time_s).all()


@pytest.mark.parametrize("tolerance", [0.01, 0.05, 0.2, 0.45])
def test_the_speed_at_which_the_limit_fails(tolerance: float) -> None:
    """A failure means the stated speed is not where the slip time is short by the tolerance."""
    speed = slow_speed_limit_mm_s(BLOCK, tolerance=tolerance)
    short = 1 - slow_stick_slip(BLOCK, speed).slip_time_s / stick_slip(BLOCK, speed).slip_time_s
    assert short == pytest.approx(tolerance, rel=1e-9)


def test_slow_pulling_is_the_limit_of_the_exact_form() -> None:
    """v → 0: t_sl → π √(m/k); v → ∞: twice that."""
    free = np.pi * np.sqrt(2.0 / 50e3)
    speeds = BLOCK.critical_speed_mm_s * np.array([1e-6, 1e6])
    assert stick_slip(BLOCK, speeds).slip_time_s == pytest.approx([free, 2 * free], rel=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [{"mass_kg": 0.0}, {"load_N": -1.0}, {"mu_dynamic": 0.6}, {"mu_static": np.nan}, {"mu_dynamic": -0.1}],
)
def test_meaningless_blocks_are_refused(wrong: dict[str, float]) -> None:
    """A failure means NaN or a square root of a negative number further down."""
    values = {
        "mass_kg": 2.0,
        "stiffness_N_per_mm": 50.0,
        "load_N": 30.0,
        "mu_static": 0.6,
        "mu_dynamic": 0.45,
    }
    with pytest.raises(InputError, match=f"`{next(iter(wrong))}`"):
        SpringBlock(**(values | wrong))


def test_meaningless_arguments_are_refused() -> None:
    """A failure means a division by zero speed, or a tolerance that no speed has."""
    for speed in (0.0, -1.0, np.inf):
        with pytest.raises(InputError, match="speed_mm_s"):
            stick_slip(BLOCK, speed)
    with pytest.raises(InputError, match="tolerance"):
        slow_speed_limit_mm_s(BLOCK, tolerance=0.5)
    with pytest.raises(InputError, match="cycles"):
        integrate_motion(BLOCK, 1.0, cycles=0)
