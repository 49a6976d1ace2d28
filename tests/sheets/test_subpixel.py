"""Each fit on single ridges: the publication's to the last digit, the sliding one without locking."""

import numpy as np
import pytest

from tests.scenes.combs import as_strip, comb, ridges, strip
from vision.errors import InputError
from vision.sheets import Starts, choose_window, paper_vertex, sliding_vertex, track_sheets
from vision.sheets.ridges import RidgeComb
from vision.sheets.subpixel import gather, match_sheet

PLACES = np.linspace(49.5, 51.5, 201)


def one_ridge(places=PLACES, *, fwhm_px=7.0, snr=1e6, seed=0):
    """One ridge in 100 columns, at another place in every frame; and where to start."""
    profile = strip(ridges(places[:, None], width=100, fwhm_px=fwhm_px), snr=snr, seed=seed).values
    return profile, Starts(np.arange(len(places)), np.rint(places).astype(np.int64))


@pytest.mark.parametrize("window", [5, 9, 13])
def test_the_papers_fit_is_polyfit(window):
    """A failure means `--fit paper` is not the publication's method."""
    profile, starts = one_ridge(snr=50)
    half = window // 2
    expected = []
    for line, start in zip(profile.astype(np.float64), starts.x, strict=True):
        peak = start - 3 + int(np.argmax(line[start - 3 : start + 4]))
        square, slope, _ = np.polyfit(np.arange(-half, half + 1), line[peak - half : peak + half + 1], 2)
        expected.append(peak - slope / (2 * square))
    x = paper_vertex(profile, starts, window_px=window).x_px
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-9)


def test_sliding_is_where_the_slope_of_the_parabola_is_zero():
    """A failure means the sliding fit solves another equation than it says."""
    profile, starts = one_ridge(snr=200)
    x = sliding_vertex(profile, starts, window_px=9).x_px
    offsets = np.arange(-4, 5)
    for line, place in zip(profile.astype(np.float64)[::20], x[::20], strict=True):
        centre = np.arange(int(place) - 1, int(place) + 3)
        slope = [np.polyfit(offsets, line[c - 4 : c + 5], 2)[1] for c in centre]
        cubic = np.polyfit(centre - int(place), slope, 3)
        assert np.polyval(cubic, place - int(place)) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("fwhm", [6.0, 8.0])
def test_without_noise_only_the_papers_fit_locks(fwhm):
    """A failure means a bias that depends on the fraction of the pixel, which no averaging takes away."""
    profile, starts = one_ridge(fwhm_px=fwhm)
    assert np.ptp(sliding_vertex(profile, starts).x_px - PLACES) < 0.002
    assert 0.1 < np.ptp(paper_vertex(profile, starts).x_px - PLACES) < 0.22


def test_a_template_never_moves_the_mean():
    """A failure means positions with a template cannot be compared with those without."""
    profile, starts = one_ridge(snr=50)
    first = sliding_vertex(profile, starts).x_px
    x = match_sheet(profile, starts.frame, first, 6).x_px
    assert x.mean() == pytest.approx(first.mean(), abs=1e-3)
    assert np.std(x - PLACES) < np.std(first - PLACES)


def dimmed(light, creep_px=1.5, seed=0):
    """Sixteen sheets with a shoulder that creep slowly, under this light (frame, 1 or x). Truth, strip."""
    x = 200 + 22.0 * (np.arange(16) - 7.5)
    x = x + creep_px * np.linspace(0, 1, len(light))[:, None] * np.linspace(0.8, 1.2, 16)
    grey = (40 + 60 * (ridges(x, width=400) + 0.5 * ridges(x + 5, width=400, fwhm_px=5.0))) * light
    noise = np.random.default_rng(seed).normal(0, 0.6, grey.shape)
    return x, as_strip((grey + noise).astype(np.float32))


@pytest.mark.parametrize("creep_px", [1.5, 3.0])
def test_light_that_fades_while_sheets_creep_is_no_part_of_their_shape(creep_px):
    """A failure means that the template takes the fading for shape, which holds positions back where the
    sheets were as bright: one in fifty is off by five errors, and called ok."""
    x, picture = dimmed(1 - 0.6 * np.linspace(0, 1, 300)[:, None], creep_px)
    tracks = track_sheets(picture)
    assert tracks.attrs["fit"] == "template"
    off = tracks.x_px.values - x
    off -= np.median(off, axis=0)
    stated = tracks.x_err_px.values
    assert (np.abs(off) < 5 * stated).all()
    assert 0.9 < np.sqrt(np.mean((off / stated) ** 2)) < 1.1
    assert np.std(off) < 0.8 * np.std(track_sheets(picture, fit="sliding").x_px.values - x)


def test_errors_of_a_template_grow_as_the_light_fades():
    """A failure means that dim frames claim the precision of bright ones."""
    profile, starts = one_ridge(snr=50)
    light = np.linspace(1, 0.25, len(PLACES))[:, None]
    noise = np.random.default_rng(1).normal(0, 1, profile.shape)
    first = sliding_vertex(profile, starts).x_px
    fitted = match_sheet(profile * light + noise, starts.frame, first, 6)
    at_full_light = fitted.err_per_noise * light[:, 0]
    np.testing.assert_allclose(at_full_light, np.median(at_full_light), rtol=0.15)


def test_what_covers_a_ridge_has_no_position_by_its_template():
    """Text over a ridge in some frames: its pixels say nothing of where the ridge is. A failure means that it
    gets a position with the error of the others, or that the other frames' shape suffers."""
    profile, starts = one_ridge(snr=50)
    covered = profile.copy()
    covered[60:70] = 100 - profile[60:70]
    covered[120:130] = 40.0 + np.random.default_rng(2).normal(0, 1, (10, 100))
    first = sliding_vertex(profile, starts).x_px
    clean = match_sheet(profile, starts.frame, first, 6)
    fitted = match_sheet(covered, starts.frame, first, 6)
    hidden = np.isnan(fitted.x_px)
    assert hidden[60:70].all() and hidden[120:130].all() and hidden.sum() == 20
    assert (np.isnan(fitted.err_per_noise) == hidden).all()
    assert np.std((fitted.x_px - PLACES)[~hidden]) < 1.1 * np.std(clean.x_px - PLACES)
    np.testing.assert_allclose(fitted.err_per_noise[~hidden], clean.err_per_noise[~hidden], rtol=0.1)


@pytest.mark.parametrize("place", [1.0, 97.0])
def test_windows_that_leave_the_picture_give_nothing(place):
    """A failure means positions are made up from pixels that do not exist."""
    profile, starts = one_ridge(np.full(3, place))
    assert np.isnan(sliding_vertex(profile, starts).x_px).all()
    assert np.isnan(paper_vertex(profile, starts).x_px).all()


def test_without_a_ridge_there_is_no_position():
    """A failure means flat or rising grey gives positions."""
    for line in (np.full(100, 50.0), np.arange(100.0), -((np.arange(100) - 120.0) ** 2)):
        profile = line[None].astype(np.float32)
        starts = Starts(np.zeros(1, np.int64), np.array([50]))
        assert np.isnan(sliding_vertex(profile, starts).x_px).all()
        assert np.isnan(paper_vertex(profile, starts).x_px).all()


@pytest.mark.parametrize(("fwhm", "expected"), [(3, 5), (6, 9), (9, 9), (14, 9), (20, 29)])
def test_the_window_follows_the_width_outside_6_to_14_px(fwhm, expected):
    """A failure means the publication's window is used where it does not fit, or not where it does."""
    comb = RidgeComb("bright", fwhm, pitch_px=60.0, contrast=50.0, noise=1.0, count=10.0, width_px=600)
    assert choose_window(comb, None) == expected


def test_texture_on_flat_ridges_is_no_motion():
    """Ridges with flat tops 13 px wide creep under light with a texture that stands still. A failure means
    that the window lies on the flat top, and that positions are those of the texture, by up to ten errors."""
    x = comb(120, per_side=8, axis_px=220.0, pitch_px=26.0, period=40.0, slip=0.25)
    texture = np.random.default_rng(3).normal(size=460)
    texture = 0.02 * np.convolve(texture, np.hanning(9) / np.linalg.norm(np.hanning(9)), "same")
    light = ridges(x, width=460, fwhm_px=2.5, flat_px=13.0) * (1 + texture)
    tracks = track_sheets(strip(light, snr=300))
    away = tracks.x_px.values - x
    away = np.abs(away - np.nanmedian(away, axis=0))
    assert tracks.attrs["window_px"] > 13
    assert track_sheets(strip(light, snr=300), fit="paper").attrs["window_px"] == 9
    assert np.nanmax(away) < 0.2
    assert np.nanmean(away > 5 * tracks.x_err_px.values) < 0.01


@pytest.mark.parametrize("window", [8, 1, -3])
def test_impossible_windows_are_refused(window):
    """A failure means an even window shifts every position by half a pixel without a word."""
    picture = strip(ridges(np.tile([30.0, 60.0], (5, 1)), width=100))
    with pytest.raises(InputError, match="odd number"):
        track_sheets(picture, window_px=window)


@pytest.mark.parametrize("columns", [5, 60])
def test_pixels_outside_the_frame_are_unknown(columns):
    """A failure means that a fit near an edge takes pixels of the other edge, or of another frame."""
    rng = np.random.default_rng(0)
    profile = rng.normal(size=(4, columns)).astype(np.float32)
    starts = Starts(rng.integers(0, 4, 300), rng.integers(-columns, 2 * columns, 300))
    offsets = np.arange(-3, 5)
    found = gather(profile, starts, offsets)
    for row, frame, start in zip(found, *starts, strict=True):
        inside = [(j, start + k) for j, k in enumerate(offsets) if 0 <= start + k < columns]
        assert np.isfinite(row).sum() == len(inside)
        assert all(row[j] == profile[frame, x] for j, x in inside)
