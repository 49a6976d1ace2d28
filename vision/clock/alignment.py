"""Alignment of two trains of slips, the camera's and the load cell's.

An alignment is a clock (an offset and a drift) that maps the camera's slips onto the machine's. Candidates
are found by voting for offsets, refined by least squares, and ranked by their log-likelihood. The model:
within the time that both trains cover, every camera slip is either a slip of the force, with a Gaussian
error, or false; every slip of the force is seen or missed. Where both instruments measured the sizes of the
slips, these count too. Slips are nearly periodic, so an alignment shifted by whole slips fits nearly as well
as the right one, and unrelated trains can agree by chance: `align_slips` tests for both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vision.clock.settings import ClockSettings
from vision.memory import in_two_threads
from vision.numeric import Floats, Ints, Rows, mad_sigma, nearest_sorted, sigma_about_zero, with_minus
from vision.signals import running_median

# --- trains of slips ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlipSizes:
    """Sizes of the slips of a train, relative to their neighbours: the steps of the sheets and the drops of
    the force both decrease slowly through a test, at any offset."""

    # Standard scores about the trend, (slips,), clipped to ±2 because merged slips and dust give outliers;
    # NaN where not known.
    score: Floats
    reliability: float = 1.0  # correlation of the scores with error-free ones, 0 to 1

    @classmethod
    def of(cls, size: Floats, error: Floats | float = 0.0, settings: ClockSettings = ClockSettings()) -> Self:
        """Scores of the slips in their order, from sizes and standard errors in the same unit.

        The trend is a straight line (Theil and Sen's) and, in long trains, a running median.
        """
        known = np.isfinite(size) & (size > 0)
        score = np.full(len(size), np.nan)
        if known.sum() < 5:  # too few for a scatter
            return cls(score, 0.0)
        deviation = np.log(size[known])
        order = np.arange(len(deviation))
        every = 1 + len(order) // 1001  # slopes of all pairs are compared
        level, at = deviation[::every], order[::every]
        earlier, later = np.triu_indices(at.size, 1)
        slope = np.median((level[later] - level[earlier]) / (at[later] - at[earlier]))
        deviation = deviation - np.median(level) - slope * (order - np.median(at))
        if len(order) >= 2 * settings.size_trend_slips:
            deviation -= running_median(deviation, settings.size_trend_slips)
        scatter = float(sigma_about_zero(deviation))
        noise = float(np.median(np.broadcast_to(error, size.shape)[known] / size[known]))
        if not scatter > max(noise, 1e-9):
            return cls(score, 0.0)
        score[known] = np.clip(deviation / scatter, -2, 2)
        return cls(score, float(np.sqrt(1 - (noise / scatter) ** 2)))


@dataclass(frozen=True)
class SlipTrains:
    """The slips of one test as recorded by the camera and by the load cell."""

    video_s: Floats  # times in order, s, on the camera's clock
    error_s: Floats  # standard error of the time between a camera slip and its force slip, s
    force_s: Floats  # times in order, s, on the machine's clock
    video_size: SlipSizes | None = None  # sizes of the slips, if known
    force_size: SlipSizes | None = None
    force_error_s: float = 0.001  # standard error of the time of a force slip, s

    @property
    def period_s(self) -> float:
        """Mean time between slips in the denser of the two trains."""
        return float(min(np.ptp(t) / (len(t) - 1) for t in (self.video_s, self.force_s) if len(t) > 1))

    @property
    def typical_error_s(self) -> float:
        """Median error of a slip's time."""
        return float(np.median(self.error_s))

    def pair_gain(self, settings: ClockSettings) -> Floats:
        """Log-likelihood gain of a pair with zero residual over two unpaired slips, (video slips,).

        It is limited, however precise both times are: otherwise one more slip at the end of an even train,
        which is seen by chance, would decide between shifts by a whole slip.
        """
        # The 1 is the cost of the presence of an unrelated slip (a Poisson process: rate times time).
        density = 1 + np.log(self.period_s / (self.error_s * np.sqrt(2 * np.pi)))
        gain = np.clip(density, 0.0, settings.largest_pair_gain) + 2 * np.log(settings.share_seen)
        return np.asarray(gain - 2 * settings.log_p_missed)


# --- the likelihood of a clock ------------------------------------------------------------------------------


@dataclass(frozen=True)
class CandidateClocks(Rows):
    """K clocks, t_force = middle_s + (1 + drift) (t_video - centre_s); each array is (K,)."""

    middle_s: Floats
    drift: Floats
    centre_s: Floats

    def map(self, video_s: Floats) -> Floats:
        """Force clock at these video times, (K, times)."""
        return np.asarray(
            self.middle_s[:, None] + (1 + self.drift[:, None]) * (video_s - self.centre_s[:, None])
        )

    @property
    def offset_s(self) -> Floats:
        """Force clock at video time 0."""
        return self.middle_s - (1 + self.drift) * self.centre_s


@dataclass(frozen=True)
class ClockFits(Rows):
    """How well K clocks fit two trains."""

    log_likelihood: Floats  # minus that of no matched slip, with the prior of the drift, (K,)
    size_evidence: Floats  # the part of it that comes from the sizes, (K,)
    error_scale: Floats  # factor by which the errors of the slips were widened, (K,)
    residual_s: Floats  # mapped minus force time, NaN where not paired, (K, video slips)
    partner: Ints  # index of the force slip, -1 where not paired, (K, video slips)
    video: Ints  # number of camera slips in the time that both trains cover, (K,)
    force: Ints  # number of force slips in that time, (K,)

    @property
    def matched(self) -> Ints:
        """Number of pairs, (K,)."""
        return np.asarray((self.partner >= 0).sum(axis=1))


def fit_clocks(
    trains: SlipTrains, clocks: CandidateClocks, settings: ClockSettings = ClockSettings()
) -> ClockFits:
    """Fit of each clock: pairs of slips and their log-likelihood.

    Pairs are mutual nearest neighbours that are likelier as a pair than as two unpaired slips. Stated errors
    may be too small; for each clock they are widened where that raises the likelihood by more than chance
    does.
    """
    mapped = clocks.map(trains.video_s)
    partner = nearest_sorted(trains.force_s, mapped)
    residual = mapped - trains.force_s[partner]
    # Whether each camera slip is the nearest one to its partner, (K, video slips), by a key for both.
    key = partner + len(trains.force_s) * np.arange(len(partner))[:, None]
    nearest = np.full(len(partner) * len(trains.force_s), np.inf)
    np.minimum.at(nearest, key.ravel(), np.abs(residual).ravel())
    mutual = np.abs(residual) <= nearest[key]
    video, force = _in_common_time(trains, mapped)
    z2 = (residual / trains.error_s) ** 2
    prior = -0.5 * (1e6 * clocks.drift / settings.drift_prior_ppm) ** 2
    largest_gain = trains.pair_gain(settings)
    gains = [largest_gain - np.log(scale) - 0.5 * z2 / scale**2 for scale in settings.error_scales]
    gain = np.stack([np.where(mutual, np.maximum(g, 0.0), 0.0) for g in gains])
    widened = np.array(settings.error_scales) > 1
    best = np.argmax(gain.sum(axis=2) - settings.least_widening_gain * widened[:, None], axis=0)
    gain = np.take_along_axis(gain, best[None, :, None], axis=0)[0]
    paired = gain > 0
    partner = np.where(paired, partner, -1)
    sizes = np.zeros(len(partner))
    if trains.video_size and trains.force_size:
        sizes = size_evidence(trains.video_size, trains.force_size, partner, settings)
    return ClockFits(
        log_likelihood=gain.sum(axis=1) + settings.log_p_missed * (video + force) + prior + sizes,
        size_evidence=sizes,
        error_scale=np.asarray(settings.error_scales)[best],
        residual_s=np.where(paired, residual, np.nan),
        partner=partner,
        video=video,
        force=force,
    )


def _in_common_time(trains: SlipTrains, mapped_s: Floats) -> tuple[Ints, Ints]:
    """Numbers of camera and of force slips from the later first slip to the earlier last one, (K,) each. The
    first or last slips of a train may be too small to be detected."""
    slack = 3 * trains.typical_error_s
    start = np.maximum(mapped_s[:, 0], trains.force_s[0]) - slack
    stop = np.minimum(mapped_s[:, -1], trains.force_s[-1]) + slack
    video = ((mapped_s >= start[:, None]) & (mapped_s <= stop[:, None])).sum(axis=1)
    force = np.searchsorted(trains.force_s, stop, "right") - np.searchsorted(trains.force_s, start)
    return np.asarray(video), np.maximum(force, 0)


def size_evidence(
    video: SlipSizes, force: SlipSizes, partner: Ints, settings: ClockSettings = ClockSettings()
) -> Floats:
    """Log-likelihood ratio of the sizes of paired slips: slips that belong together to unrelated ones, (K,).

    The likelihood is averaged over the correlations that the sizes may have, including none. The result is 0
    where the sizes of either train do not vary beyond their errors.  partner: index of the force slip of each
    camera slip, -1 where not paired, (K, video slips).
    """
    v = np.broadcast_to(video.score, partner.shape)
    f = force.score[np.maximum(partner, 0)]
    known = (partner >= 0) & np.isfinite(v) & np.isfinite(f)
    v, f = np.where(known, v, 0.0), np.where(known, f, 0.0)
    false, unrelated = settings.false_size_share, settings.unrelated_sizes
    evidence = [np.full(len(partner), np.log(unrelated))]
    for correlation in np.multiply(settings.size_correlations, video.reliability * force.reliability):
        unexplained = 1 - correlation**2
        ratio = np.exp(0.5 * (f**2 - (f - correlation * v) ** 2 / unexplained)) / np.sqrt(unexplained)
        each = np.minimum(np.log(false + (1 - false) * ratio), settings.largest_size_gain)
        total = np.where(known, each, 0.0).sum(axis=1)
        evidence.append(total + np.log((1 - unrelated) / len(settings.size_correlations)))
    return np.asarray(np.logaddexp.reduce(np.stack(evidence)))


# --- the search ---------------------------------------------------------------------------------------------


def find_alignments(
    trains: SlipTrains, settings: ClockSettings = ClockSettings()
) -> tuple[CandidateClocks, ClockFits]:
    """Different alignments, best first; there is at least one.

    Two clocks count as the same alignment if they agree within three errors of a slip at both ends of the
    camera's train.
    """
    clocks = _refine(trains, _vote(trains, settings), settings)
    fits = fit_clocks(trains, clocks, settings)
    order = np.argsort(-fits.log_likelihood, kind="stable")
    ends = clocks.map(trains.video_s[[0, -1]])[order]
    differs = np.abs(ends[:, None] - ends[None]).max(axis=2) > 3 * trains.typical_error_s
    new = np.array([differs[i, :i].all() for i in range(len(order))])
    rows = order[new]
    return clocks.take(rows), fits.take(rows)


def _vote(trains: SlipTrains, settings: ClockSettings) -> CandidateClocks:
    """The offsets with the highest scores over all drifts.

    The work grows with the third power of the number of slips, so a long train votes in parts, each for the
    offsets at its own middle, which `_refine` extends to the whole train.
    """
    slips = np.arange(len(trains.video_s))
    parts = np.array_split(slips, -(-slips.size // settings.voting_slips))

    def vote(part: Ints) -> Floats:
        some = replace(trains, video_s=trains.video_s[part], error_s=trains.error_s[part])
        return _vote_of_part(some, settings)

    votes = in_two_threads(vote, parts)
    middle, drift, centre, score = np.concatenate(votes, axis=1)
    best = np.argsort(-score, kind="stable")[: settings.candidates]
    return CandidateClocks(middle, drift, centre).take(best)


def _vote_of_part(trains: SlipTrains, settings: ClockSettings) -> Floats:
    """Middle, drift and centre of the clocks with the highest scores, and these scores, (4, K).

    Every pair of a camera slip and a force slip votes for the offset at which they coincide. The score of an
    offset is its approximate log-likelihood: votes within three bins count as pairs without residual.
    """
    centre = 0.5 * (trains.video_s[0] + trains.video_s[-1])
    span = min(np.ptp(trains.video_s), np.ptp(trains.force_s))
    width, most = _bin_s(trains), 1e-6 * settings.largest_drift_ppm
    count = int(np.ceil(most * span / width)) * 2 + 1
    drifts = np.linspace(-most, most, count)
    low = trains.force_s[0] - centre - (1 + most) * np.ptp(trains.video_s)
    high = trains.force_s[-1] - centre + (1 + most) * np.ptp(trains.video_s)
    bins = int(np.ceil((high - low) / width)) + 1
    score, best = np.full(bins, -np.inf), np.zeros(bins)
    for drift in drifts:
        scaled = (1 + drift) * (trains.video_s - centre)
        with_drift = _offset_scores(trains, scaled, low + centre, width, bins, settings)
        score, best = np.maximum(score, with_drift), np.where(with_drift > score, drift, best)
    # The highest bins that no neighbour within two exceeds.
    highest = sliding_window_view(np.pad(score, 2, "edge"), 5).max(axis=1)
    maxima = np.flatnonzero((score == highest) & np.isfinite(score))
    chosen = maxima[np.argsort(-score[maxima], kind="stable")[: settings.candidates]]
    if not len(chosen):
        chosen = np.array([int(np.argmax(score))])
    middle = low + centre + width * (chosen + 0.5)
    return np.stack([middle, best[chosen], np.full(len(chosen), centre), score[chosen]])


def _bin_s(trains: SlipTrains) -> float:
    """Width of a bin of offsets, s; a vote counts for its bin and both neighbours."""
    return max(1.5 * trains.typical_error_s, trains.period_s / 60)


def _offset_scores(
    trains: SlipTrains, scaled: Floats, low: float, width: float, bins: int, settings: ClockSettings
) -> Floats:
    """Approximate log-likelihood of every bin of offsets at one drift, (bins,).

    scaled: times of the camera slips at that drift, s.  low, width: start and width of the bins, s.
    """
    first, last = trains.force_s[[0, -1]]
    voted = ((trains.force_s - low) / width)[None, :] - (scaled / width)[:, None]
    votes = np.bincount(voted.astype(np.int64).ravel(), minlength=bins)[:bins]
    votes = np.convolve(votes, np.ones(3, np.int64), "same")

    def number_below(offset_s: Floats) -> Ints:
        """Number of these offsets below the middle of each bin."""
        index = np.clip(np.ceil((offset_s - low) / width - 0.5), 0, bins).astype(np.int64)
        return np.asarray(np.cumsum(np.bincount(index, minlength=bins + 1))[:bins])

    # A slip enters the common time at one offset and leaves it at another.
    force = number_below(trains.force_s - scaled[-1] - width)
    force -= number_below(trains.force_s - scaled[0] + width)
    video = number_below(first - scaled - width) - number_below(last - scaled + width)
    fewest = np.minimum(force, video)
    gain = float(np.median(trains.pair_gain(settings)))
    score = gain * np.minimum(votes, fewest) + settings.log_p_missed * (force + video)
    return np.where(fewest >= 3, score, -np.inf)  # fewer common slips agree at too many offsets


def _refine(trains: SlipTrains, clocks: CandidateClocks, settings: ClockSettings) -> CandidateClocks:
    """Refine clocks by robust least squares on the pairs of nearest slips, with errors that narrow down from
    the bins of the vote to those of the slips."""
    v, full_weight = trains.video_s, trains.error_s**-2.0
    widest = 1.4 * _bin_s(trains) / trains.typical_error_s
    for widening in np.r_[np.geomspace(widest, 1.0, 4), 1.0, 1.0]:
        mapped = clocks.map(v)
        target = trains.force_s[nearest_sorted(trains.force_s, mapped)]
        z2 = ((mapped - target) / (widening * trains.error_s)) ** 2
        # Probability of a true pair: nearly constant for small residuals, because a slip between two frames
        # has a uniform error, and one half at 2.5 errors.
        weight = full_weight / (1 + np.exp(0.5 * (np.minimum(z2, 60.0) - 2.5**2)))
        clocks = _least_squares(v, target, weight, clocks, 1e-6 * settings.drift_prior_ppm)
    return clocks


def _least_squares(
    v: Floats, target: Floats, weight: Floats, clocks: CandidateClocks, drift_prior: float
) -> CandidateClocks:
    """Lines from v to target, with a prior on the drift; unchanged clocks where all weights are 0."""
    total = weight.sum(axis=1)
    known = total > 0
    total = np.where(known, total, 1.0)
    centre = np.where(known, (weight * v).sum(axis=1) / total, clocks.centre_s)
    dv = v - centre[:, None]
    excess = target - dv
    middle = (weight * excess).sum(axis=1) / total
    drift = (weight * dv * excess).sum(axis=1) / ((weight * dv**2).sum(axis=1) + drift_prior**-2)
    return CandidateClocks(
        np.where(known, middle, clocks.middle_s), np.where(known, drift, clocks.drift), centre
    )


# --- ambiguity of the best alignment ------------------------------------------------------------------------


@dataclass(frozen=True)
class Alignments:
    """The alignments of two trains, best first."""

    trains: SlipTrains  # the slips
    clocks: CandidateClocks
    fits: ClockFits
    margin: float  # log-likelihood of the best minus that of the next; inf if there is only one
    ambiguity: str  # why the best one is ambiguous; "" if it is not
    settings: ClockSettings  # those of the search

    def errors(self) -> tuple[float, float, float]:
        """Standard errors of the best clock: at the centre of its slips, s; of the drift; at time 0, s."""
        paired = self.fits.partner[0] >= 0
        weight = (self.trains.error_s[paired] * self.fits.error_scale[0]) ** -2.0
        if not paired.any():
            return float("nan"), float("nan"), float("nan")
        from_centre = self.trains.video_s[paired] - self.clocks.centre_s[0]
        prior = (1e-6 * self.settings.drift_prior_ppm) ** -2
        drift = 1 / np.sqrt((weight * from_centre**2).sum() + prior)
        centre = 1 / np.sqrt(weight.sum())
        # The errors at the centre and of the drift are independent.
        return float(centre), float(drift), float(np.hypot(centre, drift * self.clocks.centre_s[0]))


def align_slips(trains: SlipTrains, settings: ClockSettings = ClockSettings()) -> Alignments:
    r"""Find the alignments of two trains and test whether the best one is ambiguous.

    The best alignment is not ambiguous where

    - it pairs so many slips that unrelated recordings would not;
    - its log-likelihood exceeds the next one's by `least_margin` (by twice that if it is not far above that
      of unrelated slips or if the sizes disagree; by more if errors had to be widened);
    - intervals or sizes are uneven enough to exclude a shift by one slip;
    - neighbouring residuals are uncorrelated, unlike those of unrelated even trains and those after lost
      frames;
    - no other offset fits the slips before or after some time much better, as where a whole slip is lost.
    """
    clocks, fits = find_alignments(trains, settings)
    likelihood = fits.log_likelihood
    margin = float(likelihood[0] - likelihood[1]) if len(likelihood) > 1 else float("inf")
    return Alignments(
        trains, clocks, fits, margin, _ambiguity(trains, clocks, fits, margin, settings), settings
    )


def _ambiguity(
    trains: SlipTrains, clocks: CandidateClocks, fits: ClockFits, margin: float, settings: ClockSettings
) -> str:
    """Why the best alignment is ambiguous, "" where it is not; the cheapest tests come first."""
    scale = fits.error_scale[0]
    widened = scale**2
    # Sizes count only against other alignments of the same trains: where times agree by chance, so do the
    # durations of the sticks, and with them the sizes.
    likelihood = fits.log_likelihood[0] - max(fits.size_evidence[0], 0.0)
    least = settings.least_likelihood if scale == 1 else settings.clear_likelihood * widened
    matched = int(fits.matched[0])
    if matched < settings.least_matched:
        return f"too few slips in common ({matched}, at least {settings.least_matched} needed)"
    if likelihood < least:
        return (
            f"the times of the {matched} slips in common fit too loosely to exclude chance (their "
            f"log-likelihood is {likelihood:.1f}, {least:.3g} needed)"
        )
    sizes_agree = fits.size_evidence[0] > -0.5
    strictness = widened * (1 if likelihood >= settings.clear_likelihood and sizes_agree else 2)
    needed = settings.least_margin * strictness
    if margin <= needed:
        return f"the next alignment fits nearly as well (margin {margin:.1f}, {needed:.3g} needed)"
    # Shifts with less than half the overlap have fewer sizes.
    shifts = fits.size_evidence[1:][fits.force[1:] >= 0.5 * fits.force[0]]
    by_sizes = float(fits.size_evidence[0] - shifts.max(initial=0.0))
    evidence = _interval_evidence(trains, fits, settings) + max(by_sizes, 0.0)
    # Longer unrelated trains are compared at more offsets and agree more often.
    least_evidence = settings.least_margin + np.log(len(trains.video_s) + len(trains.force_s))
    if evidence <= least_evidence:
        return "times and sizes of the slips are too regular to exclude a shift by one slip"
    # Correlation of neighbouring residuals, in standard errors (von Neumann's ratio).
    z = (fits.residual_s[0] / trains.error_s)[fits.partner[0] >= 0]
    correlation = 1 - np.sum(np.diff(z) ** 2) / (2 * max(np.sum(z**2), np.finfo(float).tiny))
    if correlation * np.sqrt(len(z)) > settings.largest_wander:
        return "neighbouring residuals are correlated: the clocks differ by more than an offset and a rate"
    return _jump(trains, clocks, settings)


def _interval_evidence(trains: SlipTrains, fits: ClockFits, settings: ClockSettings) -> float:
    """Log-likelihood that a shift by one slip loses by the scatter of the intervals alone: it moves each slip
    by the difference of one interval from the mean one. A trend of the intervals is no evidence."""
    paired = np.unique(fits.partner[0][fits.partner[0] >= 0])
    interval = np.diff(trains.force_s[paired])
    comparable = np.abs(np.diff(np.log(interval))) < 0.5  # else a slip is missed or false between them
    change = np.diff(interval)[comparable]
    if not len(change):
        return 0.0
    # The errors of the force slips add to the scatter: a change depends on three times, twice on the middle
    # one, which adds 6 variances.
    spread = float(mad_sigma(change))
    scatter2 = spread**2 / 2 - 3 * trains.force_error_s**2
    error = trains.typical_error_s * fits.error_scale[0]
    most = np.median(trains.pair_gain(settings))
    return float(len(interval) * min(0.5 * max(scatter2, 0.0) / error**2, 0.5 * most))


def _jump(trains: SlipTrains, clocks: CandidateClocks, settings: ClockSettings) -> str:
    """Whether the slips before or after some time fit another offset much better; "" if they do not. Where a
    recording loses as much as one slip, those beyond pair with their neighbours nearly as well."""
    mapped, period = clocks.map(trains.video_s)[0], trains.period_s
    slack = 3 * trains.typical_error_s  # slips before or after the force was recorded would fit any offset
    common = (mapped > trains.force_s[0] - slack) & (mapped < trains.force_s[-1] + slack)
    mapped, error, most = mapped[common], trains.error_s[common], trains.pair_gain(settings)[common]
    reach = settings.largest_jump_periods * period
    first, stop = (np.searchsorted(trains.force_s, mapped + side * reach) for side in (-1, 1))
    near = first[:, None] + np.arange((stop - first).max(initial=0))  # force slips that a jump can reach
    shift = trains.force_s[np.minimum(near, len(trains.force_s) - 1)] - mapped[:, None]
    shift = np.sort(shift[(near < stop[:, None]) & (np.abs(shift) > 0.25 * period)])
    shift = shift[:: 1 + len(shift) * len(mapped) // settings.jumped_slips]

    def gain(by_s: Floats) -> Floats:
        """Log-likelihood of each slip beyond that of an unpaired one after a jump, (jumps, slips)."""
        jumped = mapped + by_s[:, None]
        z2 = ((jumped - trains.force_s[nearest_sorted(trains.force_s, jumped)]) / error) ** 2
        return np.asarray(np.maximum(most - 0.5 * z2, 0.0))

    lead = gain(shift) - gain(np.zeros(1))
    beyond = settings.least_jump_slips - 1
    before = np.cumsum(lead, axis=1)[:, beyond:]
    after = np.cumsum(lead[:, ::-1], axis=1)[:, beyond:]
    if max(before.max(initial=0.0), after.max(initial=0.0)) <= settings.least_jump_lead:
        return ""
    at_end = after.max() > before.max()
    row, slips = np.unravel_index(int(np.argmax(after if at_end else before)), after.shape)
    slips += settings.least_jump_slips
    first = trains.video_s[common][-slips if at_end else slips - 1]
    step = with_minus(f"{shift[row]:+.3g}")
    return (
        f"the {slips} slips {'from' if at_end else 'up to'} {first:.6g} s of the film fit better"
        f" {step} s from the offset of the others (lost frames or samples? a clock that jumps?)"
    )
