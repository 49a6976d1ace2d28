"""The rule that calls clocks ambiguous: `_ambiguity`, with its thresholds in `ClockSettings`.

Slips are nearly periodic, so that an alignment shifted by whole slips fits nearly as well as the right one,
and unrelated trains can agree by chance. An alignment is believed only where none of the tests here objects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vision.clock.alignment import (
    CandidateClocks,
    ClockFits,
    SlipSizes,
    SlipTrains,
    find_alignments,
    off_trend,
)
from vision.clock.settings import ClockSettings
from vision.numeric import NORMAL_MEDIAN, Floats, Ints


@dataclass(frozen=True)
class Alignments:
    """The alignments of two trains, best first."""

    trains: SlipTrains  # the slips
    # clocks, fits: the candidates and how well they fit
    clocks: CandidateClocks
    fits: ClockFits
    margin: float  # log-likelihood of the best over the next; inf where there is only one
    ambiguity: str  # why the best one is ambiguous; "" where it is not
    settings: ClockSettings  # with which they were found

    def errors(self) -> tuple[float, float]:
        """Standard errors of the best clock: at the centre of its slips, s, and of its drift."""
        paired = self.fits.partner[0] >= 0
        weight = (self.trains.error_s[paired] * self.fits.error_scale[0]) ** -2.0
        if not paired.any():
            return float("nan"), float("nan")
        away = self.trains.video_s[paired] - self.clocks.centre_s[0]
        prior = (1e-6 * self.settings.drift_prior_ppm) ** -2
        drift = 1 / np.sqrt((weight * away**2).sum() + prior)
        return float(1 / np.sqrt(weight.sum())), float(drift)


def align(trains: SlipTrains, settings: ClockSettings = ClockSettings()) -> Alignments:
    r"""Find the alignments of two trains and test whether the best one is ambiguous.

    Parameters
    ----------
    trains
        The slips that camera and load cell saw.
    settings
        See `ClockSettings`.

    Returns
    -------
    The alignments, best first, with the reason why the best is ambiguous or "".

    Notes
    -----
    The best alignment is not ambiguous where

    - it pairs enough slips to be no coincidence of unrelated recordings;
    - its log-likelihood exceeds the next one's by `least_margin` (twice that where it is not itself far above
      that of unrelated slips or the sizes disagree, and more where errors had to be widened);
    - its lead over shifts of similar overlap exceeds what slips missed at random on both sides give an even
      train: with shares :math:`p` and :math:`q` of the :math:`n` force slips and of the camera's slips
      paired, the number of pairs of a wrong shift scatters by :math:`\sqrt{n p (1 - p) (1 - q)}`;
    - intervals or sizes are uneven enough to exclude a shift by one slip;
    - neighbouring residuals are not alike: unrelated even trains drift through each other smoothly, and lost
      frames shift all later ones;
    - it exceeds the best alignments of random permutations of the intervals.
    """
    clocks, fits = find_alignments(trains, settings)
    likelihood = fits.log_likelihood
    margin = float(likelihood[0] - likelihood[1]) if len(likelihood) > 1 else float("inf")
    return Alignments(trains, clocks, fits, margin, _ambiguity(trains, fits, margin, settings), settings)


def _ambiguity(trains: SlipTrains, fits: ClockFits, margin: float, settings: ClockSettings) -> str:
    """Why the best alignment is ambiguous, "" where it is not; the cheapest tests first."""
    scale = fits.error_scale[0]
    widened = scale**2
    # Sizes are evidence only against other alignments of the same trains: where times agree by chance, the
    # lengths of the sticks do, and the sizes with them.
    likelihood = fits.log_likelihood[0] - max(fits.size_evidence[0], 0.0)
    least = settings.least_likelihood if scale == 1 else settings.clear_likelihood * widened
    if fits.matched[0] < settings.least_matched or likelihood < least:
        return f"the {fits.matched[0]} slips in common are too few, or fit too loosely, to exclude chance"
    sizes_agree = fits.size_evidence[0] > -0.5
    strict = widened * (1 if likelihood >= settings.clear_likelihood and sizes_agree else 2)
    needed = settings.least_margin * strict
    if margin <= needed:
        return f"the next alignment fits nearly as well (margin {margin:.1f}, {needed:.3g} needed)"
    chance = _lead_by_missed_slips(trains, fits, settings)
    if _lead_over_shifts(fits, fits.log_likelihood) <= chance:
        return "slips missed on both sides could explain the lead over shifts by whole slips"
    by_sizes = min(_lead_over_shifts(fits, fits.size_evidence), float(fits.size_evidence[0]))
    evidence = _interval_evidence(trains, fits, settings) + max(by_sizes, 0.0)
    # Longer unrelated trains are tried at more offsets, and agree more often.
    least_evidence = settings.least_margin + np.log(len(trains.video_s) + len(trains.force_s))
    if evidence <= max(least_evidence, chance):
        return "times and sizes of the slips are too regular to exclude a shift by one slip"
    if _wander(fits, trains) > settings.largest_wander:
        return "neighbouring residuals are alike: the clocks do not differ by an offset and a rate alone"
    lead = settings.permutation_lead * strict
    if not exceeds_permutation_null(trains, fits.log_likelihood[0], lead, settings):
        return "random permutations of the camera's intervals fit nearly as well"
    return ""


def _lead_over_shifts(fits: ClockFits, value: Floats) -> float:
    """Lead of the best alignment's value over others with at least half its slips in common; inf without."""
    shifts = value[1:][fits.force[1:] >= 0.5 * fits.force[0]]
    return float(value[0] - shifts.max(initial=-np.inf))


def _lead_by_missed_slips(trains: SlipTrains, fits: ClockFits, settings: ClockSettings) -> float:
    """The lead over shifts of an even train that slips missed at random can give."""
    matched, force, video = int(fits.matched[0]), int(fits.force[0]), int(fits.video[0])
    p, q = (matched + 1) / (force + 2), (matched + 1) / (video + 2)
    scatter = np.sqrt(max(force * p * (1 - p) * (1 - q), 0.0))
    return float(settings.missed_slips_sigma * scatter * np.median(trains.pair_gain(settings)))


def _interval_evidence(trains: SlipTrains, fits: ClockFits, settings: ClockSettings) -> float:
    """By how much a shift by one slip lowers the likelihood through the unevenness of the intervals alone.

    It moves each slip by how far one interval differs from the usual one; neighbours give the scatter, so
    that a trend is no evidence.
    """
    paired = np.unique(fits.partner[0][fits.partner[0] >= 0])
    interval = np.diff(trains.force_s[paired])
    alike = np.abs(np.diff(np.log(interval))) < 0.5  # others have missed or false slips between them
    change = np.abs(np.diff(interval))[alike]
    if not len(change):
        return 0.0
    # Errors of the force's slips look uneven, too: three of them, the middle one twice, make a change.
    uneven2 = (float(np.median(change)) / NORMAL_MEDIAN) ** 2 / 2 - 3 * trains.force_error_s**2
    error = trains.typical_error_s * fits.error_scale[0]
    most = np.median(trains.pair_gain(settings))
    return float(len(interval) * min(0.5 * max(uneven2, 0.0) / error**2, 0.5 * most))


def _wander(fits: ClockFits, trains: SlipTrains) -> float:
    """Correlation of neighbouring residuals in standard errors (von Neumann's ratio)."""
    z = (fits.residual_s[0] / trains.error_s)[fits.partner[0] >= 0]
    alike = 1 - np.sum(np.diff(z) ** 2) / (2 * max(np.sum(z**2), np.finfo(float).tiny))
    return float(alike * np.sqrt(len(z)))


def exceeds_permutation_null(
    trains: SlipTrains, log_likelihood: float, lead: float, settings: ClockSettings = ClockSettings()
) -> bool:
    """Permutation test: whether camera trains with their intervals in random order align less well.

    True where no permutation comes within `lead` of `log_likelihood`, that of the best alignment of the
    trains as they are.  Intervals are exchanged together with the sizes of the slips that end them; their
    trend stays. So the permuted trains are as even, as damaged and as long as the real one, are tried at as
    many offsets and drifts, and their sizes go with their intervals as in the real one.  The random numbers
    are the same in each call; a quarter of the permutations is enough where they all stay below half the
    log-likelihood.
    """
    rng = np.random.default_rng(0)
    log_interval = np.log(np.diff(trains.video_s))
    uneven = off_trend(log_interval, settings)
    highest = -np.inf
    for count in range(1, settings.permutations + 1):
        order = rng.permutation(len(log_interval))
        permuted = _permuted(trains, log_interval - uneven + uneven[order], order)
        reached = float(find_alignments(permuted, settings)[1].log_likelihood[0])
        if reached > log_likelihood - lead:
            return False
        highest = max(highest, reached)
        if 4 * count >= settings.permutations and highest < 0.5 * log_likelihood:
            break
    return True


def _permuted(trains: SlipTrains, log_interval: Floats, order: Ints) -> SlipTrains:
    size = trains.video_size
    return replace(
        trains,
        video_s=np.cumsum(np.r_[trains.video_s[0], np.exp(log_interval)]),
        video_size=size and SlipSizes(np.r_[size.score[:1], size.score[1:][order]], size.reliability),
    )
