"""All tunable constants of reading video: the strip, blank frames, lost frames, waiting and memory."""

from __future__ import annotations

from dataclasses import dataclass

from vision.data import Tunable
from vision.files import ANSWER_S


@dataclass(frozen=True, kw_only=True, repr=False)
class VideoSettings(Tunable):
    """Settings of `find_strip`, `measure_strip` and `strip_profile`. The tests named are in tests/video."""

    # the strip
    sample_frames: int = 8
    """Frames, spread over the recording, in which the strip is searched. More average out noise and cost
    decoding; with 4 the tilt found in the real recordings changes by up to 3 degrees."""
    bands: int = 96
    """Largest number of bands into which the height is divided. More place the strip's ends more finely, at
    a cost that grows with the square; 96 are 2 to 12 rows of usual pictures. Scenes of test_strip_find fail
    at 48 and at 200, none at 144."""
    segment_px: int = 64
    """Width of the segments along x. Narrower ones limit the effect of a label better but may fall between
    two ridges; test_wide_ridges_avoid_clamp_and_label has ridges 160 px apart."""
    segment_cap: float = 0.65
    """Quantile of the segments to which their slope power is limited. Higher lets labels and marks decide,
    lower the weakest ridges; shown by the labels in test_strip_find."""
    ridge_share: float = 0.02
    """A segment shows ridges if its slope power is at least this share of the third-strongest one's. Larger
    leaves out weak ridges, smaller includes empty width
    (test_a_comb_that_fills_a_fifth_of_the_width_keeps_all_its_rows)."""
    ridge_rows: float = 0.75
    """Quantile over the bands of the slope power that stands for a segment: ridges run through many rows, a
    label through a few. Larger takes a label for ridges (test_wide_ridges_avoid_clamp_and_label), smaller
    leaves out ridges that are in focus in few rows."""
    height_power: float = 0.5
    """A strip's score grows with this power of its height. Larger includes blurred or bowed rows, smaller
    retains only the clearest ones; 0.5 is the gain in signal over white noise. Shown by
    test_bowed_ridges_get_a_lower_strip."""
    slope_sigma_px: float = 1.5
    """Gaussian smoothing of slopes along x. Larger than the narrowest ridge's sigma blurs it away (FWHM 4 px
    in test_strip_find), smaller lets pixel noise in."""
    min_clarity: float = 0.3
    """Odd and even rows whose slopes correlate less than this show no ridges. Smaller finds a strip in noise
    (test_nothing_to_find), larger misses faint combs."""
    max_smear: float = 0.3
    """Tilt over the strip, in ridge widths, above which a warning is given. Larger does not warn of blurred
    ridges, which cost precision; shown by
    test_leaning_too_far_is_reported_and_the_wrong_rows_are_worse."""

    moving_change: float = 0.01
    """Share of a run's slope power that must change between the sampled frames for the run to be preferred to
    a clearer stationary one. Larger misses sheets beside a ruler that move by less than a tenth of their
    width, smaller exchanges good rows for others (test_a_ruler_is_no_comb)."""
    moving_ratio: float = 20.0
    """Factor by which this change must exceed that of the clearer run. Larger retains a ruler that vibration
    moves, smaller leaves the comb's clearest rows if others happen to move more."""

    label_power: float = 2.0
    """Slope power of a band beyond the pattern that all bands share, over the usual power of that pattern,
    above which it is text over the picture, if it is in two segments or more. Larger leaves in faint text
    (test_rows_with_the_time_of_day_are_left_out), smaller leaves out the round ends of real markers (1.0)."""
    shared_pattern: float = 0.5
    """Share of the slope power of the median band that lies in the pattern of all bands, from which this
    pattern is one of ridges. Larger does not see text over weak ridges, smaller takes rows of the real
    sarcomeres, which share none, for text."""
    few_segments: int = 6
    """Number of segments up to which text in a single one is left out, as it may decide there. Larger leaves
    out rows because of a speck, smaller leaves short text in the strip of a narrow picture
    (test_a_short_text_in_a_narrow_picture_is_left_out)."""
    max_level: float = 2.0
    """Mean square step of the grey level along z, over that along x, above which a warning says that the
    ridges may be horizontal. Larger does not warn of films of sheets that move along y (2.6 to 60 in real
    ones), smaller warns of noise (1) and of real markers with level edges (1.0); test_level_ridges."""

    edge_share: float = 0.08
    """Share of the frame's height that is left out if a strip of bowed ridges reaches its edge, where the bow
    displaces positions most. Larger costs noise (a tenth at 0.08 on both edges), smaller leaves bias to the
    outer sheets (test_bowed_ridges_lose_the_rows_at_the_frame_s_edges)."""
    edge_height: int = 64
    """Height of frames, px, below which every row is retained: the camera has cut them to the strip. Smaller
    costs noise in films that have few rows."""

    # comparison of the strip's rows (row_shifts, best_rows)
    least_bands: int = 8
    """Number of bands needed to compare rows. Fewer give no middle half to compare with."""
    least_strength: float = 0.2
    """Least strength of the ridges in a band, over that in the middle, by which displacements are divided:
    those of dim rows would be noise. Larger hides the displacement of dim rows."""
    worth_trimming: float = 0.8
    """Share to which leaving out rows must lower the expected error of positions. Larger leaves out rows
    because of noise, smaller retains bowed and shaded rows (test_strip_rows)."""
    significant_rows: float = 2.0
    """Differences between halves of the strip below this many standard errors are noise. Larger hides bias,
    smaller finds bias where there is none (test_straight_ridges_have_no_error_of_the_strip)."""
    least_bias_px: float = 0.05
    """Bias of the mean, or difference between outer and inner rows, px, below which no rows are left out.
    Smaller leaves out rows because of texture, larger retains bias above the noise of most recordings
    (test_shaded_rows_are_left_out, test_bowed_ridges_lose_the_rows_at_the_frame_s_edges)."""
    strip_warning_px: float = 0.15
    """Error from the choice of rows, px, above which a warning is given. Smaller warns of ordinary bows,
    larger does not warn of bias of several times the noise."""

    # light
    overexposed: float = 0.05
    """Share of the strip's pixels as bright as the brightest from which a warning is given. Well exposed
    films have 0.0002 to 0.002, the tops of drawn ridges without noise 0.03; larger does not warn where more
    than a pixel of each ridge is saturated (test_an_overexposed_film_is_told)."""
    column_gain: float = 0.01
    """Gain of columns that are brighter and darker in turn, over their mean, from which it is corrected. It
    is below 0.002 in ordinary films, and 0.024 or more below a Bayer pattern of unlike colours. Larger leaves
    patterns that hide ridges (test_mosaic.py), smaller changes and warns of films that it hardly helps."""
    column_sigmas: float = 6.0
    """Standard errors of that gain from which it is corrected. Films without a Bayer pattern reach 2.2, those
    with one 10 and more. Larger leaves patterns that a codec has smoothed, smaller takes sharp ridges for
    one (test_mosaic.py)."""
    padding_columns: int = 8
    """Fewest columns that count as padding beside the picture, and as a picture. Smaller takes two equal
    columns for padding, larger leaves narrow bars, which hardly reach from one sheet to the next."""
    padding_level: float = 0.02
    """Largest difference of columns of the padding from each other, over the range of grey levels. Larger
    takes for padding what is not even, smaller leaves padding that a codec has changed
    (test_padding_beside_the_picture_is_left_out)."""
    padding_step: float = 0.1
    """Step from the padding to the picture, over the range of grey levels, in nine of ten frames. Smaller
    takes an even background for padding, larger leaves bars about as bright as the picture's edge, which say
    little about the sheets (test_padding_beside_the_picture_is_left_out)."""
    few_levels: float = 100.0
    """Brightest pixel below which no overexposure is reported: with few levels, many pixels are equal.
    Smaller warns of dark films, larger does not warn if a camera of few bits overflows."""

    # blank frames
    blank_contrast: float = 0.1
    """Share of the usual contrast below which frames are blank. Larger loses frames in dimmed light, smaller
    takes noise for a picture; test_strip has both."""
    bright_contrast: float = 0.35
    """Share of the usual contrast over level below which frames brighter than usual are blank. Smaller tracks
    overexposed frames with a gradient (test_an_overexposed_frame_is_blank); larger loses blurred ones."""
    bright_level: float = 1.3
    """Factor over the median level above which frames are brighter than usual. Smaller lets flicker cost
    blurred frames, larger tracks overexposed ones (test_an_overexposed_frame_is_blank)."""
    saturated: float = 0.98
    """Share of the saturation level that every column of a white frame reaches, even if most frames are white
    (test_white_frames_are_blank_where_they_are_the_most). Smaller loses bright frames."""

    # lost frames
    gap_steps: float = 1.5
    """A step between frame times longer than this many usual ones may hide a lost frame. Smaller is misled by
    jitter, larger than 2 misses single frames (test_lost_frames_are_counted_whatever_the_jitter)."""
    late_steps: float = 0.6
    """Delay, in steps, that must persist after a gap for it to be a loss. Larger misses single lost frames
    under jitter; smaller counts late stamps (test_a_frame_that_only_came_late_is_not_lost)."""
    same_rate: float = 1.15
    """Ratio of two intervals up to which they belong to one frame rate. Larger takes 1/30 and 1/24 s for one
    rate and miscounts where both occur, smaller is misled by times in whole milliseconds
    (test_a_camera_that_changes_its_rate_loses_nothing)."""
    whole_ratio: float = 0.05
    """Relative deviation of a changed rate from half or a third of the usual one, below which frames may have
    been lost evenly. Larger warns of any slow part, smaller misses losses under jitter
    (test_evenly_lost_frames_are_told)."""
    early_end_steps: float = 3.5
    """Steps between the last frame and the end that the file states above which frames are missing. Complete
    files differ by up to two (test_cut_matroska_is_reported)."""

    # failing disks and networks
    answer_s: float = ANSWER_S
    """Seconds without any reading or computation after which reading fails (`vision.files`)."""

    # interrupted runs
    resume_after_s: float = 10.0
    """Seconds of reading after which the frames read are kept for `--resume`. Smaller writes files for films
    that are quickly read again, larger loses more if the process is killed (tests/run/test_reading.py)."""

    # recordings that are followed while they are written (tests/video/test_follow.py)
    follow_poll_s: float = 0.5
    """Interval between two checks of the file. Shorter shows new frames sooner and asks the disk more
    often."""
    follow_still_s: float = 10.0
    """Time without a change of size or time stamp after which a recording is closed. Shorter ends at a
    camera's pause."""
    follow_give_up_s: float = 60.0
    """Time without a change after which a file that cannot be opened is refused. Longer waits for a camera
    that writes its index late, in vain if there is none."""
    follow_tell_s: float = 3.0
    """Waiting time for a recording that cannot be read yet after which the reason is printed. Shorter prints
    it for every recording that has just begun."""
    follow_first: int = 64
    """Number of frames with which the strip is found. More find it more accurately and start later."""
    follow_margin: int = 32
    """Frames at the end of a growing file that are not read yet: they may be incomplete, and decoders return
    the last ones in another order. More lags behind the camera, fewer reads half-written frames."""

    # torn frames (torn.py)
    torn_lag: float = 0.3
    """Time from the upper to the lower half of the strip, and its difference from the usual one, in frames,
    from which a frame is torn. A tear in the middle has 1. Smaller takes noise for it, larger misses tears
    near the edges (test_torn.py)."""
    torn_sigmas: float = 6.0
    """Errors by which this must be clear. Smaller takes light and vibration for it, larger misses torn frames
    in which the sheets hardly move."""
    torn_share: float = 0.02
    """Share of the frames that must be torn. Smaller warns of chance, larger misses films in which few frames
    are torn; of a tenth of torn frames 2 to 8 % are clear."""
    torn_least: int = 5
    """Number of torn frames below which none is reported. Smaller warns of chance in short films, larger is
    silent in these."""

    # memory
    spill_bytes: int = 32 << 20
    """Size of I(x, t) above which it is stored in a temporary file, of which little is in memory at a time.
    32 MiB are 4400 frames of 1920 columns; larger takes that memory, smaller writes files for short films.
    The values are the same (test_spilled_profile_is_the_same)."""
    memory_bytes: int = 1 << 30
    """Size of I(x, t) above which a disk without room for that file is an error; up to it, memory is used.
    Larger may take all memory, smaller refuses films that would fit
    (test_a_full_disk_for_a_long_recording_is_reported)."""
