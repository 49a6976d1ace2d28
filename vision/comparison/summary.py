"""What several tests gave, in a few lines."""

from __future__ import annotations

import numpy as np

from vision.comparison.comparison import Comparison
from vision.comparison.joint import JointFriction
from vision.figures import plus_minus
from vision.models import Estimate

DISAGREE = 4.0  # χ²/dof from which tests do not share one μ
MOST_LINES = 6  # of tests with a change point


def summary_lines(found: Comparison) -> list[str]:
    """The joint μ, Y_eff, the collapse, change points and trends."""
    lines = [joint_line(one) for one in found.joint]
    source = ", ".join(found.modulus_from[:3]) + (" …" if len(found.modulus_from) > 3 else "")
    lines.append(f"Y_eff {plus_minus(found.modulus)} GPa held fixed ({source})")
    if found.collapse is not None:
        c = found.collapse
        lines.append(
            f"collapse: rms {c.rms_after:.2g} sheets, {c.rms_before:.2g} with one Λ̂ for all; "
            f"noise {c.rms_noise:.2g}"
        )
    changed = [one for one in found.irregular if np.isfinite(one.change_mm)]
    for one in changed[:MOST_LINES]:
        place = plus_minus(Estimate(one.change_mm, one.change_err_mm))
        lines.append(f"{one.run}: stick-slip turns irregular at d_v = {place} mm")
    if not changed:
        lines.append("stick-slip turns irregular in no test")
    claimed = [t for t in found.trends if t.claimed]
    for t in claimed:
        partial = np.isfinite(t.partial_slope)
        slope = Estimate(*((t.partial_slope, t.partial_slope_err) if partial else (t.slope, t.slope_err)))
        held = ", the other held fixed" if partial else ""
        lines.append(f"{t.quantity} with {t.predictor}: {plus_minus(slope)}{held} (p {t.p_adjusted:.2g})")
    looked = [t for t in found.trends if not t.reason]
    if looked and not claimed:
        lines.append(f"no trend among the {len(looked)} looked for")
    return lines


def joint_line(one: JointFriction) -> str:
    """One μ of several tests, and whether they share it."""
    whose = one.sample or "all tests"
    line = f"{whose}: one μ for {len(one.runs)} tests {plus_minus(one.mu)}"
    if np.isfinite(one.amplitude.value):
        line += f", A {plus_minus(one.amplitude)}"
    if one.disagreement > DISAGREE:
        line += f"; the tests differ by more than their errors (χ²/dof {one.disagreement:.3g})"
    if one.at_limit:
        line += f"; 𝒯0 at its limit in {', '.join(one.at_limit)}"
    return line
