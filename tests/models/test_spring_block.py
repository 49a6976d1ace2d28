"""Spring and block: closed forms against the integrated motion, and the publication's slow limit."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vision.errors import InputError
from vision.models.equations import SpringBlock, onset_of_stick_slip

BLOCK = SpringBlock(mass_kg=2.0, stiffness_N_per_mm=50.0, load_N=30.0, mu_static=0.6, mu_dynamic=0.45)


def integrated_slip(block: SpringBlock, speed_mm_s: float) -> tuple[float, float]:
    """Duration, s, and final elongation, mm, of a slip by m ü = −k u + μ_d w, from k u = μ_s w."""
    k, speed = 1000 * block.stiffness_N_per_mm, 1e-3 * speed_mm_s
    kinetic, static = block.mu_dynamic * block.load_N, block.mu_static * block.load_N

    def motion(_: float, y: np.ndarray) -> list[float]:
        return [y[1], (kinetic - k * y[0]) / block.mass_kg]

    def at_rest(_: float, y: np.ndarray) -> float:
        return float(y[1] - speed)

    at_rest.terminal, at_rest.direction = True, 1.0  # type: ignore[attr-defined]
    longest = 2.1 * np.pi * np.sqrt(block.mass_kg / k)
    start, accuracy = [static / k, speed], {"rtol": 1e-11, "atol": 1e-15, "max_step": longest / 20}
    found = solve_ivp(motion, (0, longest), start, method="DOP853", events=at_rest, **accuracy)
    assert found.t_events is not None and found.y_events is not None
    return float(found.t_events[0][-1]), 1e3 * float(found.y_events[0][-1][0])


@pytest.mark.parametrize("ratio", [0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("mu_dynamic", [0.0, 0.25, 0.45], ids=["no-friction", "springs-back", "mild"])
def test_closed_forms_follow_from_the_equation_of_motion(ratio: float, mu_dynamic: float) -> None:
    """A failure means t_st, t_sl, u0 or Δf is not that of m ü = −k u + μ_d w."""
    block = SpringBlock(
        mass_kg=2.0, stiffness_N_per_mm=50.0, load_N=30.0, mu_static=0.6, mu_dynamic=mu_dynamic
    )
    speed = ratio * block.critical_speed_mm_s
    slip, lowest = integrated_slip(block, speed)
    assert slip == pytest.approx(float(block.slip_time_s(speed)), rel=1e-9)
    assert lowest == pytest.approx(block.lowest_elongation_mm, rel=1e-8)
    highest = 0.6 * 30.0 / 50.0
    assert (highest - lowest) / speed == pytest.approx(float(block.stick_time_s(speed)), rel=1e-8)
    assert 50.0 * (highest - lowest) == pytest.approx(block.force_drop_N, rel=1e-8)


@pytest.mark.parametrize(("ratio", "percent"), [(0.1, 6), (1.0, 33), (5.0, 47)])
def test_how_short_the_slow_limit_is(ratio: float, percent: int) -> None:
    """6 % short at v/v_c = 0.1, 33 % at 1, 47 % at 5."""
    speed = ratio * BLOCK.critical_speed_mm_s
    short = 1 - BLOCK.slip_time_s(speed, slow=True) / BLOCK.slip_time_s(speed)
    assert round(100 * float(short)) == percent


def test_slow_pulling_is_the_limit_of_the_exact_form() -> None:
    """v → 0: t_sl → π √(m/k); v → ∞: twice that."""
    free = np.pi * np.sqrt(2.0 / 50e3)
    speeds = BLOCK.critical_speed_mm_s * np.array([1e-6, 1e6])
    assert BLOCK.slip_time_s(speeds) == pytest.approx([free, 2 * free], rel=1e-5)


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


def oscillation(stiffness_N_per_mm: float, mass_kg: float) -> tuple[float, float]:
    """(growth per period, period in s) of a small disturbance of steady sliding at 0.1 mm/s, integrated."""
    a, b, length, load, speed = 0.01, 0.015, 10e-6, 20.0, 1e-4
    k = 1000 * stiffness_N_per_mm

    def motion(_: float, y: np.ndarray) -> list[float]:
        stretch, v, age = y
        friction = load * (a * np.log(v / speed) + b * np.log(speed * age / length))
        return [speed - v, (k * stretch - friction) / mass_kg, 1 - v * age / length]

    start = [1e-5 * load / k, speed, length / speed]
    found = solve_ivp(motion, (0, 12.0), start, method="LSODA", rtol=1e-9, atol=1e-14, dense_output=True)
    assert found.sol is not None
    time = np.linspace(4, 12, 8001)
    stretch = found.sol(time)[0]
    top = np.flatnonzero((stretch[1:-1] > stretch[:-2]) & (stretch[1:-1] > stretch[2:])) + 1
    growth = np.log(stretch[top[-1]] / stretch[top[0]]) / (top.size - 1)
    return float(growth), float(np.diff(time[top]).mean())


@pytest.mark.parametrize("inertia", [0.01, 1.0], ids=["light", "heavy"])
def test_steady_sliding_turns_unstable_at_the_critical_stiffness(inertia: float) -> None:
    """Growth changes sign at k_c with its period; where m V² = a N D_c, k_c without inertia is half of it."""
    friction = {"a": 0.01, "b": 0.015, "critical_length_um": 10.0, "load_N": 20.0, "speed_mm_s": 0.1}
    mass = inertia * 0.01 * 20.0 * 10e-6 / 1e-4**2
    critical, period = onset_of_stick_slip(**friction, mass_kg=mass)
    assert critical == pytest.approx(10.0 * (1 + inertia))
    assert oscillation(1.02 * critical, mass)[0] < 0 < oscillation(0.98 * critical, mass)[0]
    assert oscillation(critical, mass)[1] == pytest.approx(period, rel=0.01)
    with pytest.raises(InputError, match="`b`"):
        onset_of_stick_slip(**friction | {"b": 0.01})
    with pytest.raises(InputError, match="mass_kg"):
        onset_of_stick_slip(**friction, mass_kg=-1.0)


@pytest.mark.parametrize("speed", [0.0, -1.0, np.nan, [1.0, 0.0]])
def test_a_block_that_is_not_pulled_has_no_cycle(speed):
    for time_s in (BLOCK.stick_time_s, BLOCK.slip_time_s):
        with pytest.raises(InputError, match="positive speeds"):
            time_s(speed)
