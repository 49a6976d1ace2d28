"""Every number that finding the strip, recognising blank frames and counting lost ones depends on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class VideoSettings:
    """Settings of `find_strip`, `measure_strip` and `strip_profile`. The tests named are in tests/video."""

    # the strip
    sample_frames: int = 8
    """Frames in which the strip is looked for, spread over the recording. More average out noise and cost
    decoding; with 4 the lean found in the real recordings moves by up to 3 degrees."""
    bands: int = 96
    """Height is judged in this many bands at most. More place the strip's ends more finely, at a cost that
    grows with the square; 96 are 2 to 12 rows of usual pictures. 24 or 200 pass test_strip_find too."""
    segment_px: int = 64
    """Segments along x that are judged apart. Narrower ones limit more of what a label adds but may fall
    between two ridges; test_wide_ridges_avoid_clamp_and_label has ridges 160 px apart."""
    segment_cap: float = 0.65
    """Quantile of the segments above which slope does not count. Higher lets labels and marks decide, lower
    the weakest ridges; shown by the labels in test_strip_find."""
    ridge_share: float = 0.02
    """A segment shows ridges if its slope power is at least this share of the third-strongest one's. Larger
    leaves out weak ridges, smaller takes in empty width
    (test_a_comb_that_fills_a_fifth_of_the_width_keeps_all_its_rows)."""
    ridge_rows: float = 0.75
    """Quantile over the bands of the slope power that stands for a segment: ridges run through many rows, a
    label through a few. Larger takes a label for ridges (test_wide_ridges_avoid_clamp_and_label), smaller
    leaves out ridges that are in focus in few rows."""
    height_power: float = 0.5
    """A strip's score grows with this power of its height. Larger takes in blurred or bowed rows, smaller
    keeps only the clearest ones; 0.5 is the gain in signal over white noise. Shown by
    test_bowed_ridges_get_a_lower_strip."""
    slope_sigma_px: float = 1.5
    """Gaussian smoothing of slopes along x. Larger than the narrowest ridge's sigma blurs it away (FWHM 4 px
    in test_strip_find), smaller lets pixel noise in."""
    min_clarity: float = 0.3
    """Odd and even rows whose slopes correlate less than this show no ridges. Smaller finds a strip in noise
    (test_nothing_to_find), larger misses faint combs."""
    max_smear: float = 0.3
    """Lean over the strip, in ridge widths, above which a warning is given. Larger keeps silent about blurred
    ridges, which cost precision; shown by
    test_leaning_too_far_is_reported_and_the_wrong_rows_are_worse."""

    moving_change: float = 0.01
    """Part of a run's slope power that must change between the sampled frames for it to be taken in place of
    a clearer one that stands still. Larger misses sheets that move by less than a tenth of their width beside
    a ruler, smaller leaves good rows for others (test_a_ruler_is_no_comb)."""
    moving_ratio: float = 20.0
    """Times as much that it must change. Larger keeps a ruler that a shaking camera moves, smaller leaves the
    comb's clearest rows where others happen to move more."""

    label_power: float = 2.0
    """Power of what single rows show beside the ridges, in terms of the ridges' own, above which it counts as
    written over the picture, where it is in two segments or more. Letters have 3 to 6, the round ends of real
    markers up to 1.7, sheets of paper 0.05 to 0.4; test_rows_with_the_time_of_day_are_left_out."""
    label_least_rows: float = 1 / 3
    """Rows with a label are left out only if this part of the strip is free of them. Larger keeps labels that
    shift a few ridges, smaller pays for them with the noise of all."""
    max_level: float = 2.0
    """Mean square step of the grey level along z, in terms of that along x, above which a warning says that
    the ridges may lie level. Larger keeps silent about films of sheets that move along y (2.6 to 60 in the
    real ones), smaller warns of noise (1) and of real markers with level edges (1.0); test_level_ridges.
    """

    edge_share: float = 0.08
    """Part of the frame's height left out where a strip of bowed ridges reaches its edge: there the bow moves
    positions most. Larger costs noise (a tenth at 0.08 on both edges), smaller leaves bias to the outer
    sheets (test_bowed_ridges_lose_the_rows_at_the_frame_s_edges)."""
    edge_height: int = 64
    """Frames lower than this were cut to the strip by the camera: every row is kept. Smaller costs noise in
    films that have few rows."""
    edge_bow_px: float = 0.05
    """Difference between outer and inner rows from which ridges count as bowed. Smaller leaves out rows of
    straight ridges, larger keeps bias that exceeds the noise."""

    # the rows of the strip against each other (strip_rows)
    least_bands: int = 8
    """Bands that a strip needs for its rows to be compared. Fewer give no middle half to compare with."""
    least_strength: float = 0.2
    """Bands with ridges weaker than this part of the middle's are taken as this strong, or their displacement
    would be noise divided by nothing. Larger hides the displacement of dim rows."""
    worth_trimming: float = 0.8
    """Rows are left out only if that lowers the expected error of positions to this share. Larger trims for
    the noise of the comparison, smaller keeps bowed and shaded rows (test_strip_rows)."""
    significant_rows: float = 2.0
    """Differences between halves of the strip below this many of their standard errors count as noise. Larger
    hides bias, smaller states one where there is none (test_straight_ridges_have_no_error_of_the_strip)."""
    least_bias_px: float = 0.05
    """Displacement of the mean by rows that stand apart below which none is left out. Smaller cuts strips for
    texture, larger keeps bias above the noise of most recordings (test_shaded_rows_are_left_out)."""
    strip_warning_px: float = 0.15
    """Error from the choice of rows above which a warning is given. Smaller warns of ordinary bows, larger
    keeps silent about bias of several times the noise."""

    # light
    overexposed: float = 0.05
    """Share of the strip's pixels as bright as the brightest from which a warning is given. Well exposed
    films have 0.0002 to 0.002, the tops of drawn ridges without noise 0.03; larger keeps silent where more
    than a pixel of each ridge is cut off (test_an_overexposed_film_is_told)."""
    few_levels: float = 100.0
    """Brightest pixel below which many are the brightest because levels are few, not the light too strong.
    Smaller warns of films in the dark, larger keeps silent where a camera of few bits overflows."""

    # blank frames
    blank_contrast: float = 0.1
    """Frames with less than this part of the usual contrast are blank. Larger loses frames under a dimmed
    lamp, smaller takes noise for a picture; test_strip has both."""
    bright_contrast: float = 0.35
    """The same, relative to the level, for frames that are also brighter than usual. Smaller tracks
    overexposed frames with a gradient (test_an_overexposed_frame_is_blank); larger loses blurred ones."""
    bright_level: float = 1.3
    """Brighter than usual: this many times the median level. Smaller lets flicker cost blurred frames, larger
    tracks overexposed ones (test_an_overexposed_frame_is_blank)."""
    saturated: float = 0.98
    """A frame is white if every column reaches this part of the saturation level, even where most frames are
    white (test_white_frames_are_blank_where_they_are_the_most). Smaller loses bright frames."""

    # lost frames
    gap_steps: float = 1.5
    """A step between frame times longer than this many usual ones may hide a lost frame. Smaller is misled by
    jitter, larger than 2 misses single frames (test_lost_frames_are_counted_whatever_the_jitter)."""
    late_steps: float = 0.6
    """By how many steps the frames after a gap must stay late for it to count as a loss. Larger misses single
    lost frames under jitter; smaller counts late stamps (test_a_frame_that_only_came_late_is_not_lost)."""
    early_end_steps: float = 3.5
    """Steps between the last frame and the end that the file states before its end is called missing. Files
    that are whole differ by up to two (test_cut_matroska_is_reported)."""

    # disks and networks that fail
    answer_s: float = 60.0
    """Seconds in which nothing is read and nothing computed, after which a recording is given up. Shorter
    gives up disks that have to start, longer waits for a connection that is lost
    (test_threads.py)."""

    # interrupted runs
    resume_after_s: float = 10.0
    """Seconds of reading after which what was read is kept for `--resume`. Smaller writes for films that are
    read again as fast, larger loses more to a kill (tests/run/test_reading.py)."""

    # recordings that are followed while they are written; all in tests/video/test_follow.py
    follow_poll_s: float = 0.5
    """Between two looks at the file. Shorter shows new frames sooner and asks the disk more often."""
    follow_still_s: float = 10.0
    """A recording whose size and time stand still this long is closed. Shorter ends at a camera's pause."""
    follow_give_up_s: float = 60.0
    """A file that stands still this long and cannot be opened is refused. Longer waits for a camera that
    writes its index late, and for nothing where there is none."""
    follow_tell_s: float = 3.0
    """Waiting for a recording that cannot be read yet after which the reason is told. Shorter tells of every
    recording that has only just begun."""
    follow_first: int = 64
    """Frames waited for before the strip is found. More place it better and start later."""
    follow_margin: int = 32
    """Frames at the end of a growing file that are left for later: they may not be whole, and decoders give
    the last ones in another order. More lags behind the camera, fewer reads half-written frames."""

    # memory
    spill_bytes: int = 1 << 30
    """I(x, t) beyond this size lives in a temporary file. 1 GiB is 140 000 frames of 1920 columns; smaller
    saves memory and costs time. The values are the same (test_spilled_profile_is_the_same)."""


DEFAULTS = VideoSettings()
