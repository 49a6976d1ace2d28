"""Alignment of two trains of slips, the camera's and the load cell's.

An alignment is a clock, an offset and a drift, that maps the camera's slips onto the machine's. Candidates
are found by voting for offsets, refined by least squares, and ranked by their log-likelihood: within the time
that both trains cover, every camera slip is either a slip of the force, with a Gaussian error, or false, and
every slip of the force is seen or missed. Where both instruments measured how large the slips were, sizes
count too.

Slips are nearly periodic, so that an alignment shifted by whole slips fits nearly as well as the right one,
and unrelated trains can agree by chance. An alignment is believed only where no test of `_ambiguity` objects.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vision.clock.settings import ClockSettings
from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Ints
from vision.signals import running_median

# --- trains of slips ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlipSizes:
    """Sizes of the slips of a train, relative to their neighbours.

    Both the steps of the sheets and the drops of the force fall slowly through a test, which tells nothing:
    only how a slip differs from its neighbours is evidence.
    """

    # Standard scores about the running trend, (slips,), limited to 2 as two slips seen as one or dust may be
    # far off; NaN where not known.
    score: Floats
    reliability: float = 1.0  # correlation of the scores with those without measurement error, 0 to 1

    @classmethod
    def of(cls, size: Floats, error: Floats | float = 0.0, settings: ClockSettings = ClockSettings()) -> Self:
        """From positive sizes in the order of the slips and their standard errors, both in the same unit."""
        known = np.isfinite(size) & (size > 0)
        score = np.full(len(size), np.nan)
        if known.sum() < 5:  # no scatter to compare with
            return cls(score, 0.0)
        off = off_trend(np.log(size[known]), settings)
        scatter = float(np.median(np.abs(off))) / NORMAL_MEDIAN
        noise = float(np.median(np.broadcast_to(error, size.shape)[known] / size[known]))
        if not scatter > max(noise, 1e-9):
            return cls(score, 0.0)
        score[known] = np.clip(off / scatter, -2, 2)
        return cls(score, float(np.sqrt(1 - (noise / scatter) ** 2)))


def off_trend(values: Floats, settings: ClockSettings) -> Floats:
    """Values less a straight line (Theil and Sen's) and, where they are many, a running median."""
    slope, level = _theil_sen(values)
    away = values - level - slope * np.arange(len(values))
    window = settings.size_trend_slips
    return away - running_median(away, window) if len(away) >= 2 * window else away


def _theil_sen(values: Floats) -> tuple[float, float]:
    """Median of the slopes between all pairs, and the intercept through the medians."""
    place = np.arange(len(values), dtype=float)
    later, earlier = np.tril_indices(len(values), -1)
    slope = float(np.median((values[later] - values[earlier]) / (place[later] - place[earlier])))
    return slope, float(np.median(values) - slope * np.median(place))


@dataclass(frozen=True)
class SlipTrains:
    """The slips of one test as the camera and as the load cell saw them."""

    video_s: Floats  # times in order, s, on the camera's own clock
    error_s: Floats  # standard error of the place of each camera slip, that of the force slips included, s
    force_s: Floats  # times in order, s, on the machine's clock
    video_size: SlipSizes | None = None  # how large the slips were, where that is known
    force_size: SlipSizes | None = None
    force_error_s: float = 0.001  # standard error of the place of a force slip, s

    @property
    def period_s(self) -> float:
        """Mean time between slips, the shorter of the two trains'."""
        return float(min(np.ptp(t) / (len(t) - 1) for t in (self.video_s, self.force_s)))

    @property
    def typical_error_s(self) -> float:
        """Median error of a slip."""
        return float(np.median(self.error_s))

    def pair_gain(self, settings: ClockSettings) -> Floats:
        """Log-likelihood that a pair without residual gains over two slips left unpaired, (video slips,).

        Limited, however sharp both times are: otherwise one slip more at the end of an even train would
        decide between shifts by a whole slip, and which slip is the first or last one seen is chance.
        """
        # The 1 is what an unrelated slip would cost for being there at all (rate times time, per slip).
        density = 1 + np.log(self.period_s / (self.error_s * np.sqrt(2 * np.pi)))
        gain = np.clip(density, 0.0, settings.largest_pair_gain) + 2 * settings.log_p_seen
        return np.asarray(gain - 2 * settings.log_p_missed)


# --- the likelihood of a clock ------------------------------------------------------------------------------


@dataclass(frozen=True)
class CandidateClocks:
    """K clocks: t_force = middle_s + (1 + drift) (t_video - centre_s), each array (K,)."""

    middle_s: Floats
    drift: Floats
    centre_s: Floats

    def map(self, video_s: Floats) -> Floats:
        """Force clock at these video times, (K, times)."""
        return np.asarray(
            self.middle_s[:, None] + (1 + self.drift[:, None]) * (video_s - self.centre_s[:, None])
        )

    def take(self, rows: Ints) -> CandidateClocks:
        """Some of them."""
        return CandidateClocks(self.middle_s[rows], self.drift[rows], self.centre_s[rows])

    @property
    def offset_s(self) -> Floats:
        """Force clock at video time 0."""
        return self.middle_s - (1 + self.drift) * self.centre_s


@dataclass(frozen=True)
class ClockFits:
    """How well K clocks fit two trains."""

    log_likelihood: Floats  # less that of no slip in common, the prior of the drift included, (K,)
    size_evidence: Floats  # the part of it that comes from the sizes, (K,)
    error_scale: Floats  # by how much the errors of the slips were widened, (K,)
    residual_s: Floats  # mapped less force time, NaN where not paired, (K, video slips)
    partner: Ints  # index of the force slip, -1 where not paired, (K, video slips)
    video: Ints  # slips of the camera's train in the time that both cover, (K,)
    force: Ints  # those of the force

    @property
    def matched(self) -> Ints:
        """Pairs, (K,)."""
        return np.asarray((self.partner >= 0).sum(axis=1))

    def take(self, rows: Ints) -> ClockFits:
        """Some of them."""
        return ClockFits(*(getattr(self, part.name)[rows] for part in fields(self)))


def fit_clocks(
    trains: SlipTrains, clocks: CandidateClocks, settings: ClockSettings = ClockSettings()
) -> ClockFits:
    """Log-likelihood of each clock.

    Pairs are mutual nearest neighbours whose gain exceeds what two slips left unpaired cost. Stated errors
    may be too small; they are widened, clock by clock, where that raises the likelihood by more than chance
    does.
    """
    mapped = clocks.map(trains.video_s)
    partner = _nearest(trains.force_s, mapped)
    residual = mapped - trains.force_s[partner]
    mutual = _is_mutual(partner, np.abs(residual), len(trains.force_s))
    video, force = _in_common_time(trains, mapped)
    z2 = (residual / trains.error_s) ** 2
    prior = -0.5 * (1e6 * clocks.drift / settings.drift_prior_ppm) ** 2
    without_residual = trains.pair_gain(settings)
    gains = [without_residual - np.log(s) - 0.5 * z2 / s**2 for s in settings.error_scales]
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


def _nearest(force_s: Floats, mapped_s: Floats) -> Ints:
    """Index of the force slip nearest to each time, any shape."""
    right = np.clip(np.searchsorted(force_s, mapped_s), 1, len(force_s) - 1)
    closer = mapped_s - force_s[right - 1] < force_s[right] - mapped_s
    return np.asarray(np.where(closer, right - 1, right))


def _is_mutual(partner: Ints, away_s: Floats, force: int) -> Bools:
    """Whether no other camera slip lies nearer to the same force slip."""
    key = partner + force * np.arange(len(partner))[:, None]
    least = np.full(key.shape[0] * force, np.inf)
    np.minimum.at(least, key.ravel(), away_s.ravel())
    return np.asarray(away_s <= least[key])


def _in_common_time(trains: SlipTrains, mapped_s: Floats) -> tuple[Ints, Ints]:
    """(video, force) slips in the time from the later first slip to the earlier last one, (K,) each.

    Not of the recordings but of the slips: a train's end is no evidence, its first or last slips may be too
    small to be seen.
    """
    slack = 3 * trains.typical_error_s
    start = np.maximum(mapped_s[:, 0], trains.force_s[0]) - slack
    stop = np.minimum(mapped_s[:, -1], trains.force_s[-1]) + slack
    video = ((mapped_s >= start[:, None]) & (mapped_s <= stop[:, None])).sum(axis=1)
    force = np.searchsorted(trains.force_s, stop, "right") - np.searchsorted(trains.force_s, start)
    return np.asarray(video), np.maximum(force, 0)


def size_evidence(
    video: SlipSizes, force: SlipSizes, partner: Ints, settings: ClockSettings = ClockSettings()
) -> Floats:
    """Log of how much likelier the sizes of the paired slips are if they belong together, (K,).

    Averaged over all correlations that the sizes may have, none among them. With the default settings one
    pair adds at most 1 and subtracts at most 1.6, all pairs together subtract at most 2.3; 0 where either
    side's sizes do not vary beyond their errors.  partner: index of the force slip of each camera slip, -1
    where not paired, (K, video slips).
    """
    v = np.broadcast_to(video.score, partner.shape)
    f = force.score[np.maximum(partner, 0)]
    both = (partner >= 0) & np.isfinite(v) & np.isfinite(f)
    v, f = np.where(both, v, 0.0), np.where(both, f, 0.0)
    false, unrelated = settings.false_size_share, settings.unrelated_sizes
    evidence = [np.full(len(partner), np.log(unrelated))]
    for correlation in np.multiply(settings.size_correlations, video.reliability * force.reliability):
        free = 1 - correlation**2
        ratio = np.exp(0.5 * (f**2 - (f - correlation * v) ** 2 / free)) / np.sqrt(free)
        each = np.minimum(np.log(false + (1 - false) * ratio), settings.largest_size_gain)
        total = np.where(both, each, 0.0).sum(axis=1)
        evidence.append(total + np.log((1 - unrelated) / len(settings.size_correlations)))
    return np.asarray(np.logaddexp.reduce(np.stack(evidence)))


# --- the search ---------------------------------------------------------------------------------------------


def find_alignments(
    trains: SlipTrains, settings: ClockSettings = ClockSettings()
) -> tuple[CandidateClocks, ClockFits]:
    """Different alignments, best first; at least one.

    Two clocks are the same alignment where they agree within three errors of a slip at both ends of the
    camera's train.
    """
    clocks = _refine(trains, _vote(trains, settings), settings)
    fits = fit_clocks(trains, clocks, settings)
    order = np.argsort(-fits.log_likelihood, kind="stable")
    ends = clocks.map(trains.video_s[[0, -1]])[order]
    apart = np.abs(ends[:, None] - ends[None]).max(axis=2) > 3 * trains.typical_error_s
    first = np.array([apart[i, :i].all() for i in range(len(order))])
    rows = order[first]
    return clocks.take(rows), fits.take(rows)


def _vote(trains: SlipTrains, settings: ClockSettings) -> CandidateClocks:
    """The most promising offsets over all drifts: at each offset, pairs that agree against slips in common.

    The score is the likelihood with every pair in three bins counted as one without residual.
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
        here = _votes(trains, (1 + drift) * (trains.video_s - centre), low + centre, width, bins, settings)
        score, best = np.maximum(score, here), np.where(here > score, drift, best)
    chosen = _summits(score, settings.candidates)
    middle = low + centre + width * (chosen + 0.5)
    return CandidateClocks(middle, best[chosen], np.full(len(chosen), centre))


def _bin_s(trains: SlipTrains) -> float:
    """Width of a bin of offsets; a vote counts for its bin and both neighbours.

    Bins finer than a sixtieth of a period only cost time, as the refinement narrows the offset down.
    """
    return max(1.5 * trains.typical_error_s, trains.period_s / 60)


def _votes(
    trains: SlipTrains, scaled: Floats, low: float, width: float, bins: int, settings: ClockSettings
) -> Floats:
    """Approximate likelihood for every bin of offsets at one drift."""
    first, last = trains.force_s[[0, -1]]
    offset = (trains.force_s[None, :] - scaled[:, None]).ravel()
    votes = np.bincount(((offset - low) / width).astype(np.int64), minlength=bins)[:bins]
    votes = np.convolve(votes, np.ones(3, np.int64), "same")

    def passed(offset_s: Floats) -> Ints:
        """How many of these offsets lie below each bin's middle."""
        index = np.clip(np.ceil((offset_s - low) / width - 0.5), 0, bins).astype(np.int64)
        return np.asarray(np.cumsum(np.bincount(index, minlength=bins + 1))[:bins])

    # A slip enters the common time at one offset and leaves it at another.
    force = passed(trains.force_s - scaled[-1] - width) - passed(trains.force_s - scaled[0] + width)
    video = passed(first - scaled - width) - passed(last - scaled + width)
    fewest = np.minimum(force, video)
    gain = float(np.median(trains.pair_gain(settings)))
    score = gain * np.minimum(votes, fewest) + settings.log_p_missed * (force + video)
    return np.where(fewest >= 3, score, -np.inf)  # two slips in common agree at too many offsets


def _summits(score: Floats, most: int) -> Ints:
    """The highest bins that no neighbour within two exceeds."""
    highest = sliding_window_view(np.pad(score, 2, "edge"), 5).max(axis=1)
    top = np.flatnonzero((score == highest) & np.isfinite(score))
    if not len(top):
        return np.array([int(np.argmax(score))])
    return top[np.argsort(-score[top], kind="stable")[:most]]


def _refine(trains: SlipTrains, clocks: CandidateClocks, settings: ClockSettings) -> CandidateClocks:
    """Robust least squares: each slip with its nearest partner, weights that fall with the residual.

    The errors start as wide as the bins of the vote and narrow down to the slips' own.
    """
    v, weight0 = trains.video_s, trains.error_s**-2.0
    widest = 1.4 * _bin_s(trains) / trains.typical_error_s
    for widening in np.r_[np.geomspace(widest, 1.0, 4), 1.0, 1.0]:
        mapped = clocks.map(v)
        target = trains.force_s[_nearest(trains.force_s, mapped)]
        z2 = ((mapped - target) / (widening * trains.error_s)) ** 2
        # Probability of a true pair: flat inside, as the errors of slips between two frames are uniform, and
        # one half at 2.5 errors.
        weight = weight0 / (1 + np.exp(0.5 * (np.minimum(z2, 60.0) - 2.5**2)))
        clocks = _least_squares(v, target, weight, clocks, 1e-6 * settings.drift_prior_ppm)
    return clocks


def _least_squares(
    v: Floats, target: Floats, weight: Floats, clocks: CandidateClocks, drift_prior: float
) -> CandidateClocks:
    """Straight lines through the pairs, the drift held by its prior; as before where all weights are 0."""
    total = weight.sum(axis=1)
    good = total > 0
    total = np.where(good, total, 1.0)
    centre = np.where(good, (weight * v).sum(axis=1) / total, clocks.centre_s)
    dv = v - centre[:, None]
    excess = target - dv
    middle = (weight * excess).sum(axis=1) / total
    drift = (weight * dv * excess).sum(axis=1) / ((weight * dv**2).sum(axis=1) + drift_prior**-2)
    return CandidateClocks(
        np.where(good, middle, clocks.middle_s), np.where(good, drift, clocks.drift), centre
    )


# --- is the best one ambiguous? -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Alignments:
    """The alignments of two trains, best first."""

    trains: SlipTrains  # the slips
    clocks: CandidateClocks
    fits: ClockFits  # how well these fit
    margin: float  # log-likelihood of the best over the next; inf where there is only one
    ambiguity: str  # why the best one is ambiguous; "" where it is not
    settings: ClockSettings  # with which they were found

    def errors(self) -> tuple[float, float, float]:
        """Standard errors of the best clock: at the centre of its slips, s; drift; at video time 0, s."""
        paired = self.fits.partner[0] >= 0
        weight = (self.trains.error_s[paired] * self.fits.error_scale[0]) ** -2.0
        if not paired.any():
            return float("nan"), float("nan"), float("nan")
        away = self.trains.video_s[paired] - self.clocks.centre_s[0]
        prior = (1e-6 * self.settings.drift_prior_ppm) ** -2
        drift = 1 / np.sqrt((weight * away**2).sum() + prior)
        centre = 1 / np.sqrt(weight.sum())
        # Where the centre is and the drift are independent, and the drift takes the clock back to time 0.
        return float(centre), float(drift), float(np.hypot(centre, drift * self.clocks.centre_s[0]))


def align(trains: SlipTrains, settings: ClockSettings = ClockSettings()) -> Alignments:
    r"""Find the alignments of two trains and test whether the best one is ambiguous.

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
    matched = int(fits.matched[0])
    if matched < settings.least_matched:
        return f"too few slips in common ({matched}, at least {settings.least_matched} needed)"
    if likelihood < least:
        return (
            f"the {matched} slips in common fit too loosely to exclude chance (log-likelihood "
            f"{likelihood:.1f}, {least:.3g} needed)"
        )
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
