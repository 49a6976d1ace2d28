"""All tunable constants of the tracking."""

from __future__ import annotations

from dataclasses import dataclass

from vision.data import Tunable

LEAST_FRAMES = 8  # fewer do not show how values of a film scatter
QUARTER_PIXEL = 0.25 / 12**0.5  # px: standard deviation of a rounding to quarter pixels


@dataclass(frozen=True, kw_only=True, repr=False)
class TrackingSettings(Tunable):
    """Thresholds and costs of `vision.track_sheets`.

    Lengths are fractions of the ridges' width (FWHM) or pitch, so that they suit every magnification; costs
    are negative log-likelihoods in nats. Where a sentence names a scene and a value, the scene fails at that
    value. Scenes have their names in tests/scenes/identity_cases.py; "cropped combs" are those of
    tests/truth/test_identity_doubt.py, in which neither end of the comb is in view.
    """

    # --- candidates (ridges.py) ---

    noise_factor: float = 7.0
    """Least prominence of a ridge, in standard deviations of the smoothed noise. Larger loses sheets ("SNR
    10" at 14), smaller takes noise for sheets ("1 sheets" at 3.5)."""

    faint_fraction: float = 0.08
    """Least prominence, as a fraction of the typical ridge's. Larger loses faint sheets ("dust on the sensor
    beside a faint sheet" at 0.16), smaller lets in paper texture."""

    smoothing_widths: float = 0.2
    """Standard deviation of the smoothing before the search, in ridge widths. Larger merges neighbours,
    smaller leaves noise peaks; halving it changes flags in a fifth of the scenes."""

    surroundings_widths: float = 1.7
    """Half-width of the surroundings in which the prominence of a ridge is measured, in ridge widths, where a
    Gaussian has ended. Smaller cuts off ridges ("comb comes in from outside the picture" at 0.85), larger
    includes gradients of the background."""

    background_margin: float = 0.2
    """How far from the middle between bright and dark stripes all of the background beside the comb must be
    to decide, as a share of their difference. Smaller trusts uneven backgrounds, larger fewer even ones
    (test_a_background_that_seldom_says_anything_is_heard at 0.02)."""

    background_decides: float = 0.3
    """Share of the frames, less those that say the opposite, in which the background beside the comb must
    speak for the same stripes to decide. Larger takes sheets for gaps because they are wider
    (test_a_background_that_seldom_says_anything_is_heard), smaller heeds noise (0.27 in a real film that was
    compressed until it was poor)."""

    background_seen: float = 0.1
    """The same share, of frames that speak against the stripes that are taken for the sheets, from which a
    warning says so. Larger takes gaps for sheets without a word, smaller warns of single frames
    (test_a_background_that_seldom_says_anything_is_heard)."""

    even_spacing: float = 2.5
    """Stripes whose spacings differ by more than this factor between their quartiles are no comb of sheets
    and gaps in turn. Combs of sheets stay below 2.1, markers filmed in pairs exceed 3.1."""

    polarity_evidence: float = 0.5
    """Least evidence that decides which stripes of a comb without ends are the sheets: the logarithm of how
    much more the others change their widths and differ in width, times how much more they themselves differ
    in brightness. As much against the background beside the comb is warned of, also of the changes alone, and
    so are fewer than five stripes whose widths differ by less. Larger leaves more combs to their widths
    alone, smaller decides by chance where nothing moves and all sheets are alike."""

    clear_evidence: float = 1.0
    """Evidence of this kind that overrules the background beside the comb if the stripes are also narrower;
    with the logarithm of how much narrower they are, less is warned of where no background is in view. Larger
    takes gaps between boards for sheets (1.7 in the least clear scene of test_ridges.py), smaller lets noise
    overrule the background."""

    ground_step: float = 0.2
    """Fall of the level over the middle fifth of the way from a bright to a dark ridge, over that of the
    whole way, below which both may be sheets on a ground between them. It is 0.01 to 0.16 between white and
    black sheets, 0.25 or more between sheets and gaps. Larger names ordinary combs, smaller overlooks combs
    in which white and black sheets nearly touch (test_white_and_black_sheets_in_turn_are_named)."""

    ground_level: float = 0.3
    """Most that this ground differs from halfway between both, over the whole way. Larger names narrow sheets
    far apart, whose gaps are as level, smaller overlooks dark sheets that are less dark than others are
    bright."""

    same_level: float = 1 / 255
    """Median difference of the bright stripes' levels, as a share of their median, up to which the film
    counts as overexposed, and levels do not speak against the background beside the comb. Smaller takes gaps
    for sheets where a codec adds noise to one level (`test_gaps_of_an_overexposed_comb_are_no_sheets` at 0),
    larger ignores what even light tells."""

    ceiling: float = 0.2
    """How far the bright stripes' levels rise above their median, over how far they fall below it (quantiles
    of 95 and 5 %), up to which the brighter half of them is overexposed. It is 0.06 to 0.13 there, and 0.4 or
    more in ordinary films. Larger ignores levels of films in order, smaller takes gaps for sheets
    (`test_gaps_of_a_comb_that_is_overexposed_in_part_are_no_sheets`)."""

    dark_width_ratio: float = 0.9
    """Where nothing else decides, ridges are dark if the dark stripes are narrower than the bright ones by
    this factor, times what varies among five stripes or more. Nearer to 1 flips even stripes to dark, smaller
    misses broad dark ridges."""

    narrowest_widths: float = 0.25
    """A candidate narrower than this many typical widths is a hot pixel. Larger loses half-merged ridges
    ("cropped combs" at 0.5); test_ridges.py puts in hot pixels."""

    widest_widths: float = 2.5
    """A candidate wider than this many typical widths is background. Smaller loses uneven ridges ("pitch 7
    px" at 1.25)."""

    # --- fit window (subpixel.py) ---

    standard_window_px: int = 9
    """The publication's window. Wider averages more noise but includes the flanks, narrower the reverse."""

    standard_widths_px: tuple[float, float] = (6.0, 14.0)
    """Ridge widths that this window suits; with it, narrower and flat ridges lose up to five times the
    accuracy (test_accuracy.py)."""

    flat_top: float = 0.57
    """Width of a ridge where it has lost 15 % of its height, over that at half, above which the window
    follows the width. A Gaussian has 0.48, sheets on fixtures 0.47 to 0.49, a flat top 0.6 to 0.8. Larger
    lets the texture on flat tops shift positions by ten errors (test_texture_on_flat_ridges_is_no_motion),
    smaller gives up the publication's window for ridges that it suits."""

    window_per_width: float = 1.4
    """Window for other ridges, in ridge widths. Larger includes flanks and neighbours, smaller more noise;
    test_accuracy.py requires 30 mpx for ridges of 3 to 30 px."""

    template_frames: int = 100
    """Frames in which a sheet must be seen for its mean shape to be learned. With fewer the shape is noisy:
    its error is that of the profile over the root of their number."""

    template_motion_px: float = 0.2
    """Motion, rms, over which the mean shape is known between pixels."""

    template_scale: float = 0.03
    """Difference by which the template's motion may be scaled against the sliding window's."""

    template_ridges: int = 4_000_000
    """Number of ridges beyond which the template is not tried, as it holds all their pixels: about 1 GB."""

    locking_sigmas: float = 6.0
    """Standard errors from which locking to whole pixels is corrected. Smaller corrects by chance, where
    motion happens to follow the pixels; larger leaves sharp ridges locked by up to 0.07 px
    (test_distortion.py)."""

    locking_alike: float = 0.5
    """Share of the sheets, as a sum of vectors, that lie at the same place in their pixels from which locking
    is not measured; 0.2 by chance for 24 sheets. Smaller leaves sharp ridges locked (at 0.25), larger takes
    the sheets' motion for locking (at 1; test_distortion.py)."""

    locking_scatter: float = 9.0
    """Scatter of the locking between sheets over the square of its error, from which it enters the errors of
    positions. Smaller adds it to ordinary ridges, which reach 3, larger leaves it out of the errors of sharp
    ones of different widths, 50 to 4000 (test_distortion.py)."""

    # --- segments (identities.py) ---

    step_fraction: float = 0.3
    """A candidate is followed from frame to frame while it moves less than this fraction of the spacing to
    its neighbour, and a comb is at rest within it. Larger risks mistakes ("cropped combs" at 0.6), smaller
    cuts more and leaves more to the alignment."""

    least_change: float = 0.2
    """Change of the logarithms of brightness, rms over the sheets, at which a comb that seems not to move has
    jumped by a pitch. Larger misses jumps ("cropped combs" at 0.4), smaller cuts at flicker."""

    # --- reference comb (reference.py) ---

    present_inside: float = 0.3
    """Share of the frames in which a ridge must be found to be a sheet. Larger loses faint sheets ("dust on
    the sensor beside a faint sheet" at 0.6), smaller accepts specks that come and go."""

    far_outside: float = 2.6
    """Distance outside the comb, in spacings, above which a ridge does not count towards a given number of
    sheets; test_reference.py puts a speck there."""

    uneven_cost: float = 3.0
    """Cost per unit of the logarithm of spacing over pitch. Smaller takes texture for sheets
    (test_reference.py at 0.75), larger drops those of uneven combs (12 of the fixture "hostile" at 12)."""

    even_spread: float = 0.12
    """Scatter of the logarithm of the spacings up to which a comb is even; beyond it spacings count for less.
    At 0.03 and at 0.5, texture beside a comb is taken for a sheet (test_reference.py)."""

    contrast_score: float = 0.4
    """Score per unit of the logarithm of contrast. Larger drops faint sheets (test_reference.py at 0.8),
    smaller keeps faint texture (there at 0)."""

    odd_width_cost: float = 3.0
    """Cost per unit of the logarithm of width beyond the usual differences. Larger drops sheets out of focus
    (test_reference.py at 12), smaller keeps labels and texture (there at 1.5)."""

    moving_px: float = 0.7
    """Motion of the neighbours, px rms, above which a ridge between them can be called stationary. Larger
    keeps marks, smaller takes noise for motion."""

    static_fraction: float = 0.3
    """Fraction of its neighbours' motion below which a ridge is a mark. Larger drops sheets of the stiff
    centre, smaller keeps dust."""

    faint_end: float = 0.35
    """Contrast of the comb's first or last ridge, over the median of all (of the five beside it, if that is
    lower and the ridge is there in most frames), below which one more sign shows that it is no sheet. Larger
    drops unequal sheets, smaller takes background beside a speck for a sheet (test_degraded.py's dirt)."""

    dim_end: float = 0.5
    """The same for a ridge of another width that does not move along with a neighbour that moves. Larger
    drops thick sheets that slip alone, smaller takes background beside a speck for a sheet
    (test_a_bump_beside_the_comb_is_no_sheet)."""

    slow_end: float = 0.6
    """Fraction of its neighbour's motion below which such a ridge is no sheet: motion grows outwards."""

    along_end: float = 0.5
    """Correlation of its motion with its neighbour's above which such a ridge is a sheet. Whole pixels leave
    0.6 of that of two sheets. Larger drops the last sheet of a dense comb (test_reference.py at 0.9), smaller
    keeps bumps that a moving sheet shifts by chance."""

    along_beyond: float = 0.3
    """Correlation of its motion with the outermost sheet's above which a warning names a ridge that is left
    out. Larger misses sheets that move by less than a pixel, smaller warns of dust."""

    seldom_beyond: float = 0.05
    """Share of the frames from which that warning names a ridge as bright as a sheet. Beside combs with one
    sheet too few it is 0.09 to 0.3, else below 0.03. Larger misses such combs, smaller warns of specks that
    pass (test_a_part_that_slips_onto_the_next_sheets_is_named)."""

    clear_beyond: float = 0.7
    """Contrast of such a ridge, over that of the comb. Larger misses faint sheets, smaller warns of texture
    that shows at times (up to 0.5)."""

    nearest_beyond: float = 0.45
    """Distance, in pitches, from the outermost sheet from which a ridge that is left out may be a further
    sheet. Larger misses sheets close to the next, smaller warns of the second edge of a sheet."""

    odd_width: float = 1.4
    """Factor by which the width of such a ridge differs from the others' if it is no sheet."""

    wide_pitches: float = 1.6
    """Spacing, in local pitches, in which a sheet may have been overlooked. Larger misses gaps, smaller
    raises false alarms on uneven combs; test_reference.py draws 40 combs with and without a gap."""

    wide_with_ridge: float = 1.35
    """Spacing, in local pitches, in which a ridge that was left out may be a sheet. Larger misses sheets that
    nearly touch others, smaller takes dust in the gaps of uneven combs for sheets; test_reference.py."""

    mark_distorted: float = 0.06
    """Usual distortion, in ridge widths, above which a sheet may be a mark. Larger lets marks that look like
    sheets pass, smaller relies on the other sign alone."""

    mark_motion: float = 0.7
    """Fraction of its neighbours' motion below which such a sheet is stationary, even where these move by
    hundredths of a pixel."""

    odd_spacing: float = 0.25
    """Logarithm of a spacing over the pitch above which it is not the comb's: a stationary ridge there may be
    a mark or part of a ruler. Larger lets marks between sheets pass, smaller doubts dirty sheets of uneven
    combs (test_reference.py)."""

    # --- alignment (alignment.py), nats ---

    spacing_spread: float = 0.08
    """Change of a spacing that costs half a nat, in pitches. Smaller cuts combs at slips ("cropped combs" at
    0.04), larger lets spacings decide less."""

    spacing_limit: float = 8.0
    """Largest cost of one spacing: a single sheet may part from its neighbours at this cost. Larger forbids
    avalanches, smaller lets identities change anywhere."""

    brightness_spread: float = 0.25
    """Change of the logarithm of a sheet's brightness that costs half a nat. Larger ignores brightness
    ("comb comes in from outside the picture" at 0.5), smaller takes flicker for another sheet ("cropped
    combs" at 0.125)."""

    stay_cost: float = 4.0
    """Cost of a displacement of the whole comb by half a pitch; half as much for each further pitch. Larger
    rejects jumps ("cropped combs" at 8), smaller finds jumps where nothing moved."""

    covered_cost: float = 3.0
    """Cost of a missing sheet beside another missing one: an object that covers sheets covers several. Larger
    shifts combs that are half covered (test_degraded.py's hands), smaller loses sheets."""

    missing_cost: float = 6.0
    """Cost of not finding a sheet that is always seen. Smaller trades sheets for false detections ("comb
    comes in from outside the picture" at 3), larger takes dust in place of a sheet."""

    false_detection_cost: float = 7.0
    """Cost of a false detection as bright as the sheets. Smaller drops sheets ("cropped combs" at 3.5),
    larger forces specks into the comb."""

    crossing_cost: float = 2.0
    """Cost of a sheet that leaves or enters the picture with the comb's displacement. Larger keeps all sheets
    in the picture ("cropped combs" at 4), smaller makes drift too likely."""

    edge_pitches: float = 1.5
    """A comb that comes this near to the picture's edge may go on outside. Smaller closes cropped combs
    ("cropped combs" at 0.75), larger opens those that end in view."""

    frames_per_rest: int = 32
    """Frames over which a sheet's rest position is the median. More smooth out slips and ringing, fewer
    follow drift."""

    # --- detections (recovery.py) ---

    doubt: float = 3.0
    """Margin, nats, below which an identity is flagged as doubtful: odds of 20 to 1. Larger flags more
    positions, smaller lets wrong ones pass."""

    unmoved_frames: int = 8
    """Frames from one certain frame to the next within which a comb that lies where it was, and never jumps,
    did not jump by a pitch and back. Larger ends longer doubts without other evidence, smaller withholds
    sheets in plain view (tests/real: of the sarcomeres 175 positions at 0, 44 at 8)."""

    faint_reach: float = 0.3
    """Distance, in pitches, from its expected position within which a faint ridge is a missing sheet."""

    faint_contrast: float = 0.2
    """Fraction of the sheet's usual contrast that this ridge must have. Larger loses shaded sheets, smaller
    accepts noise; test_recovery.py fades a faint sheet to 0.25 and to nothing."""

    least_squeeze: float = 2.0
    """Displacement of the comb's ends towards its middle, in pitches, from which sheets are identified at the
    comb's usual spacing. Larger loses combs that slips squeeze (test_identity.py, four slips), smaller
    stretches frames for the slips of a mobile shell, which need it not."""

    squeeze_share: float = 0.7
    """Share of the variance of all spacings, in logarithms, that a squeeze of the whole comb must explain.
    Larger loses combs whose outer sheets are squeezed more, smaller stretches recordings in which a few
    spacings open (a row of markers that is released)."""

    tear_fraction: float = 0.6
    """Difference of two neighbours' displacements, in pitches, that no slip causes. Larger lets wrong
    identities pass, smaller flags avalanches."""

    jump_fraction: float = 0.45
    """Step of the whole comb, in pitches, after which its displacement needs proof: half a pitch to one side
    looks like half a pitch to the other. Larger lets combs jump the wrong way, smaller doubts slips
    (test_equal_sheets_of_a_cropped_jumping_comb_are_doubted_rather_than_swapped at 0.6)."""

    least_misfit: float = 0.075
    """Change of the logarithm of brightness of most sheets, as a standard deviation, that is compatible with
    a jump by whole pitches. Larger accepts jumps of combs that look different (test_identity_doubt.py's
    moving light at 0.3, test_sarcomeres_in_noise_are_never_a_pitch_off_all_together at 0.12), smaller doubts
    jumps because of noise."""

    leave_sigmas: float = 8.0
    """Distance from the position that its neighbours predict, over the sheet's own scatter, above which
    another ridge is searched. Larger lets hops pass, smaller doubts sheets with individual motion."""

    anchor_nats: float = 9.0
    """Log-likelihood ratio by which another numbering must be likelier for a jump to be undone; half of it,
    for each sheet, for sheets to have exchanged their ridges. Larger keeps false jumps and passes exchanged
    sheets (test_sheets_that_draw_together_until_one_is_hidden_are_not_exchanged), smaller doubts sheets that
    slip."""

    sheet_nats: float = 0.5
    """Log-likelihood ratio per sheet by which another numbering must explain a jump, or the looks of sheets,
    better. Larger passes sheets that are numbered by a neighbour (test_doubts.py at 1.5), and leaves jumps
    that a blurred slip only seems to make; smaller takes noise of the brightnesses for either."""

    part_nats: float = 13.5
    """Log-likelihood ratio by which a part of the comb must look like the sheets beside it to be doubtful.
    Larger passes sides numbered by a neighbour (test_doubts.py), smaller withholds sheets whose brightness
    wanders (sarcomeres at 9)."""

    pattern_sheets: int = 8
    """Sheets whose brightnesses and widths show that a part of the comb is numbered otherwise: the patterns
    of fewer are alike by chance."""

    pattern_ratio: float = 3.0
    """Times by which brightnesses must fit a comb that moved on by a sheet better for the recording to be cut
    there. Larger takes every sheet for the next one where a comb without an end in view jumps by its pitch
    (test_identities.py at 6), smaller takes moving light for a jump."""

    alike_scatter: float = 2.0
    """Difference of brightness and width between neighbours, over their change with time (medians), below
    which sheets look alike. It is 0.3 to 0.6 for equal sheets and 10 or more for paper. Larger warns of combs
    that have a pattern, smaller overlooks combs without one (test_identity_doubt.py)."""

    merged_widths: float = 0.8
    """Two sheets nearer to each other than this, in ridge widths, are one ridge: the resolution of two
    Gaussians."""

    merged_height: float = 1.15
    """Height over its usual height above which a ridge beside a missing sheet is both sheets. Larger passes
    sheets that touch (test_sheets_that_touch_are_one_ridge), smaller withholds ridges that brighten."""

    merged_width: float = 1.25
    """Width over its usual width above which a ridge beside a missing sheet is both sheets. Larger passes the
    middle of two sheets, smaller withholds blurred ones."""

    # --- frames that are missing, in the wrong order, or mixed from two (order.py) ---

    advance_least: float = 0.6
    """Frames of creep by which sheets must advance too far in one step for frames to be missing or in another
    order. One lost frame is 1. Smaller warns of uneven creep, larger misses single frames (test_order.py)."""

    advance_sigmas: float = 6.0
    """Standard errors by which this must be clear. Smaller warns of noise in long films, larger misses frames
    lost in slow ones."""

    advance_alike: float = 0.7
    """Correlation of such displacements with the creep of the sheets. Smaller takes sheets that jump on their
    own for lost frames, larger misses parts in another order, where sheets stand otherwise."""

    advance_scatter: float = 0.4
    """Scatter of the advance from frame to frame, in frames, above which sheets do not creep evenly enough.
    Larger takes vibration for lost frames, smaller is silent in films of uneven creep."""

    advance_clear: float = 1.0
    """Error of the advance in one step, in frames, from which nothing is reported. Larger takes other motion
    for lost frames, as of markers that ring after release (3 to 6), smaller is silent where creep is slow."""

    order_clear: float = 400.0
    """Square of the creep at each place in groups of frames, in its errors, from which it shows their order.
    Smaller lets noise decide, larger misses films in the wrong order in which the sheets creep slowly."""

    order_whole: float = 0.3
    """Relative deviation from whole multiples of the creep at which such groups may be in the wrong order.
    Larger takes more of a vibration for it (test_order.py)."""

    mixed_change: float = 0.6
    """Square of the change from the frame before, over the usual one, below which a frame may be mixed from
    two. The mean of two has 0.25. Larger adds frames that only hardly moved, smaller misses mixtures of which
    one frame is the larger part (test_order.py)."""

    mixed_noise: float = 0.25
    """Share of a frame's noise that mixed frames must lack. The mean of two lacks 0.5; frames that differ
    little for other reasons lack up to 0.17. Larger misses what a codec has changed, smaller warns of
    those."""

    mixed_sigmas: float = 6.0
    """Standard errors by which this must be clear. Mixed films have 40 or more, others up to 1. Smaller warns
    where noise or light change, larger misses few mixed frames."""

    # --- frames, blur and distortion (film.py, distortion.py) ---

    frozen_fraction: float = 0.3
    """Change from the frame before, as a fraction of what the quietest other frame changes by, below which a
    frame repeats it. Larger drops quiet frames, smaller misses repeated frames that a codec has touched up;
    test_film.py."""

    least_changing: float = 0.1
    """Fraction of the frames that must differ from the one before for the others to be repeated ones."""

    lasting_noise: float = 0.2
    """Correlation of the noise of a frame and the next above which the camera averages in time. It is up to
    0.09 in 77 films in order, 0.31 to 0.67 in averaged ones. Larger misses weak noise reduction, smaller
    warns of films that are in order (test_film.py)."""

    lag_error: float = 1.4
    """Error by the lag of averaged frames over that which the correlation predicts. In films with known
    positions the lag is 0.5 to 2.3 times as large, since rounding hides correlation. Larger overstates errors
    of motion, smaller understates them (test_frames_averaged_in_time_are_said_to_be)."""

    still_sigmas: float = 3.0
    """Times the noise that the largest twentieth of a sheet's displacements against the comb must exceed for
    it to move. Noise alone reaches 2.5 in one frame of a hundred; larger calls slow pulls stationary, smaller
    takes a pattern for a comb (test_a_pattern_that_stands_still_is_not_taken_for_a_comb_in_silence)."""

    still_share: float = 0.1
    """Share of the sheets that must move; fewer, and the comb is called stationary. Larger doubts films in
    which few sheets slip, smaller lets a single noisy ridge vouch for a pattern."""

    blur_sigmas: float = 4.0
    """Excess of width or loss of height, over the ridge's own scatter, at which it is blurred. Larger misses
    blur, smaller flags sharp slips; the error grows from half of this on."""

    blur_fraction: float = 0.2
    """Motion over a few frames, in ridge widths, from which a ridge can be blurred. Smaller flags noise."""

    cut_sigmas: float = 4.0
    """Loss of height and width, in standard deviations, from which a ridge beside a missing sheet is cut by
    what hides that sheet. Larger gives positions at the edge of a hand (test_tracks.py), smaller withholds
    sheets beside a gap for noise."""

    blur_error: float = 0.795
    """Error of a blurred position over lost height times motion; in test_film.py it must cover 62 to 74 of
    100 true positions."""

    blur_overlap: float = 1.4
    """Difference of a motion from whole pitches, in ridge widths, below which one image of a ridge overlaps
    another ridge, so that its blur follows from other sheets. Smaller calls sheets in fast slips ok that are
    off by pixels (test_film.py)."""

    least_likeness: float = 0.55
    """Correlation of a sheet's mean profile with that of all sheets, or its mirror image, below which it is
    no single ridge if sheets are alike. It is 0.2 to 0.5 where thin sheets side by side, or a patch of the
    background, were taken for one. Larger drops markers of unusual shape, smaller takes two sheets for one
    (test_distortion.py)."""

    usual_likeness: float = 0.75
    """The same for a sheet that is distorted by more than `most_distorted`. Sheets with one bright side that
    are turned over have 0.9 or more, thin ones among thick ones 0.76, a thick sheet with a thin one beside it
    0.7. Larger drops sheets that are unlike the others, smaller takes two sheets for one
    (test_distortion.py)."""

    wide_by_a_gap: float = 1.2
    """Width of a sheet, over that of the others, from which it is two sheets in one ridge if another seems to
    be missing beside it. Sheets that are alike scatter by 1.05 to 1.19, two at 0.6 to 1.1 widths from each
    other are 1.2 to 2 as wide. Larger gives a place between both, smaller withholds thick sheets beside gaps
    (test_a_sheet_against_its_neighbour_is_merged_with_it)."""

    most_distorted: float = 0.2
    """Usual distortion, in ridge widths, above which a sheet is no single ridge. A second sheet or mark that
    shifts it by a fifth of its width distorts it by 0.1 to 0.4, sheets cut out of photographs have up to
    0.19. Larger gives positions between two sheets (test_distortion.py at 0.26), smaller withholds sheets at
    hot pixels or in a shadow (test_degraded.py)."""

    distortion_sigmas: float = 4.0
    """Limit for the difference between two fits of a ridge and for the slope of the light, each over its
    noise, above which the ridge is distorted. Larger overlooks distorted ridges, smaller enlarges errors by
    chance; test_distortion.py has a highlight and a shadow beside a ridge."""

    distortion_frames: int = 9
    """Frames over which the differences and the slope are averaged. More detect smaller distortions, fewer
    follow faster ones."""

    distortion_gap: int = 24
    """Frames that a distortion lasts unseen between frames that show it, as where dirt passes the middle of a
    ridge. More also states it where it has gone, fewer leave errors too small in between
    (`test_dirt_that_passes_a_ridge_is_in_its_error_all_the_way`)."""

    distortion_error: float = 2.0
    """Error of a distorted position over the difference of the fit of its top, where the film does not show
    it. In films with known positions it is 0.6 (haze, focus) to 7 (reflections that move). Larger overstates
    errors, smaller understates them (test_distortion.py)."""

    distortion_slope: float = 0.9
    """Error of a distorted position over the difference between the fits with and without a slope of the
    background: 0.2 (haze) to 5 (reflections). Larger overstates errors in haze, smaller misses objects about
    as wide as a ridge beside it, such as graph paper (test_distortion.py)."""

    covered_width: float = 0.03
    """Least change of the logarithm of the width of a ridge that changes alone, half of which is an error:
    something covers its flank. Larger leaves out what covers a few hundredths of the width, smaller counts
    neighbours that come closer (test_distortion.py: a needle, a soft object)."""

    static_scale: tuple[float, float, float] = (1.05, 1.15, 0.65)
    """Relative error of displacements over the changes of a ridge that moves past dirt: those of the
    logarithm of its height, per px, of the fit of its top, and of the fit with a sloping background. Larger
    overstates the errors of clean sheets, smaller understates those of sheets beside dirt
    (test_distortion.py: specks on the lens)."""

    texture_shift: float = 0.3
    """Relative error of displacements over the slope of the light's logarithm times the standard deviation of
    a ridge, where light is uneven in all places. In films with known positions the factor is 0.3 to 1; other
    terms contain part of it. Larger overstates errors, smaller understates them (test_distortion.py: a
    texture of the light)."""

    texture_length: float = 0.6
    """Length, in ridge widths, over which that slope is measured, and displacement up to which the error
    grows in proportion. Larger averages out its changes (test_distortion.py at 6), smaller leaves noise."""

    leaning_sheets: int = 5
    """Neighbouring sheets that change alike as the paper leans, whose median change is no dirt. Smaller
    overstates the errors of clean sheets (test_distortion.py at 2), larger overlooks dirt on several of
    them."""

    overlap: float = 0.44
    """Ridge width over pitch above which only the height counts for this, and no texture, since flanks that
    overlap change the shape, and in part the height, with the distance of the neighbour. Larger overstates
    the errors of crowded combs (test_slight_differences_between_sheets_are_no_distortion at 0.5), smaller
    overlooks dirt."""

    static_floor: float = 0.01
    """Least of these relative errors. Smaller counts unequal pixels twice, since `fixed_pattern` of the
    deformation measures them; larger overlooks faint dirt."""

    second_comb_correlation: float = 0.4
    """Correlation between what the tops of ridges gain and what the gaps beside them lose from which a second
    comb lies over the sheets. Sound films reach 0.37, reflections have 0.4 to 0.95. Larger leaves reflections
    out of the errors, smaller enlarges errors by chance (test_second_comb.py)."""

    second_comb_opposite: float = 0.8
    """The same for the changes of all tops and gaps together. It is 0.9 to 1 under a reflection that moves as
    a whole. Larger leaves it out, smaller takes light for it (test_second_comb.py)."""

    second_comb_lopsided: float = 1.5
    """Common changes of the two sides of the ridges against each other, over what single sheets explain by
    chance, from which such changes are a second comb. They are 0.3 to 1.1 in films in haze or whose focus
    changes, 2 to 12 under reflections. Larger leaves these out, smaller takes the focus for one
    (test_second_comb.py)."""

    second_comb_shift: float = 3.0
    """Error of positions, in standard deviations of a ridge, over the light that a second comb moves from
    ridges to gaps, over their height. In films with known positions it is 2.2 to 5.5. Larger overstates
    errors, smaller understates them (test_second_comb.py)."""

    second_comb_whole: float = 2.0
    """The same for a second comb that moves over all sheets alike. In films with known positions it is 0.8 to
    2.9, and 5.5 in one. Larger overstates errors, smaller understates them (test_second_comb.py)."""

    second_comb_least_px: float = 3.5
    """Width of ridges from which a second comb is looked for. Smaller takes sharp ridges, whose tops change
    with their place among the pixels, for one (those of 1.8 px), larger is silent about reflections that
    shift narrow ridges by several errors (test_second_comb.py)."""

    second_comb_most: float = 0.1
    """Change of the level, over the ridges' height, that counts for this at most. Larger lets a hand or dirt
    decide, smaller understates strong reflections."""

    distortion_floor: float = 0.08
    """Distortion, px, below which a position does not count as distorted, and a sheet not as distorted in the
    whole film. Larger hides slight distortions, smaller counts the texture of the paper."""

    sampled_well_px: float = 5.0
    """Width of ridges from which their shape does not depend on their place among the pixels. Of narrower
    ones this is fitted and subtracted before shapes are compared. Smaller takes it for dirt
    (test_sharp_ridges_keep_their_errors), larger may take dirt for it where sheets move over whole pixels."""

    # --- stated errors (tracks.py) ---

    sharpened: float = 1.15
    """Scatter of positions over that predicted from the pixels, inverted, from which a camera is taken to
    sharpen and errors are reduced. Smaller reduces them by chance, larger overstates those of sharpened film
    (test_noise_that_a_camera_sharpens_is_in_the_errors)."""

    own_excess: float = 1.3
    """Scatter of a sheet's positions over its error, as a multiple of the usual one, from which it counts
    instead of the usual one. Smaller enlarges errors by chance, larger understates those of sheets that
    scatter more than others (test_scatter.py)."""

    most_own_excess: float = 2.0
    """The most that it counts for. Larger takes the motion of a single sheet for noise, smaller understates
    errors where flicker shifts some sheets by far more than others (test_scatter.py)."""

    slip_sigmas: float = 5.0
    """Step of a sheet, over the scatter of its steps, from which it is a slip and no noise. Larger takes the
    slips of a few sheets for noise (test_scatter.py at 20), smaller leaves out noise (there at 1.5)."""

    left_behind: tuple[float, float, float] = (0.11, 0.25, 0.3)
    """Least and largest error of a position in a film of which the quantiser is known, over the shift that
    changes a ridge's pixels by one step of it, and error over the motion between two frames, in between.
    The least is 0.06 to 0.25 in films, and hardly depends on anything else that they show. Larger overstates
    errors of films whose noise is coded, smaller understates them where sheets creep, vibrate or slip unseen
    (test_errors_hold_where_a_codec_codes_no_motion)."""

    # --- symmetry axis (numbering.py) ---

    axis_slack: float = 0.02
    """Fraction of all motion by which positions of the axis may differ and still be equally good; larger
    widens the choice in the stiff centre."""

    axis_frames: int = 9
    """Frames whose mean opening that of a slip must exceed, beyond noise. More take a zoom that changes for a
    slip, fewer miss slips that last several frames (test_numbering.py)."""

    knock_ratio: float = 2.0
    """Step of all sheets together, over the opening of the comb's ends, above which a step is the camera's.
    Larger lets one knock place the axis, smaller drops slips of films with vibration."""

    vibration_sigmas: float = 2.0
    """Vibration and unequal slips, in standard deviations of what they do to the axis, that it allows for.
    Larger leaves the axis open, smaller lets them move it; test_numbering.py has lopsided and centred combs
    that vibrate, are carried along, or slip in avalanches."""

    carried_symmetry: float = 0.8
    """Asymmetry of the motion about the comb's middle, over that about the place where it changes sign, below
    which all sheets may be carried along with every slip. Larger puts the axis of combs that lack two sheets
    of one side in the middle, smaller lets the camera place it
    (test_a_comb_that_moves_along_with_its_opening)."""

    carried_alike: float = 0.3
    """Asymmetry of the motion about the middle of a comb whose sheets mostly move alike, over the standard
    deviation of the motion, below which they are carried along. Combs that are have 0.01 to 0.04, one side
    0.2 to 0.65. Larger takes one side for both, smaller takes both for one side; a warning names either
    (test_a_comb_that_is_carried_further_than_it_opens)."""

    innermost_moves: float = 0.06
    """Motion of the innermost sheets of one side, over that of the outermost, above which a comb may be
    carried along: sheets at the axis hardly move. Smaller doubts one side of few sheets, larger
    overlooks combs whose motion is not symmetric (test_sheets_that_all_move_the_same_way_are_questioned)."""

    still_half: float = 0.25
    """Standard deviation of the motion of one half of the comb, over that of the other, below which it is the
    inner half of one side. Of two sides it is 0.85 to 1.15 (50 simulated films), and of one side of which
    vibration hides where the axis is, below 0.14. Larger takes two unlike sides for one, smaller one side for
    two (test_one_side_whose_inner_half_is_still)."""

    decided_sheets: int = 2
    """Sheets by which the axis may lie elsewhere for the motion still to have found it."""

    decided_range: float = 0.25
    """The same where only one end of the comb is in view, as a share of the sheets. With a larger one
    vibration moves the axis: with one or two of 50 sheets out of view it is 2 sheets off (rms) at 0.5, 1 at
    0.25. Smaller takes the middle of the sheets in view for it: with eight out of view it is 4 off (3.5 at
    0.5)."""


DEFAULT = TrackingSettings()
