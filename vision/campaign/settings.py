"""Tunable constants of planning and running a campaign."""

from __future__ import annotations

from dataclasses import dataclass

from vision.video.settings import DEFAULTS


@dataclass(frozen=True, kw_only=True)
class CampaignSettings:
    """Tunable constants of a campaign. `reports/campaign.py` measures the values used for estimates."""

    # estimates of a film's time and memory before any film has been measured
    base_seconds: float = 1.0
    """Time for a film's tables, pictures and report, however short the film is."""
    seconds_per_megasample: float = 0.7
    """Time per million values of I(x,t) (frames times columns): averaging, fits, identities, tables. It
    decides which films share a job and how much time a batch system is asked for. The measured times of
    finished films of the same campaign correct it."""
    seconds_per_gigapixel: float = 3.0
    """Time for reading and decoding, 1 to 4 s depending on the codec. It dominates if frames are tall."""
    base_memory_mb: float = 600.0
    """Memory for libraries, figures and report."""
    memory_mb_per_megasample: float = 40.0
    """Memory per million values of I(x,t), including blocks of the fits and tables. With too small a value, a
    batch system kills the job, which is then repeated with twice as much."""
    margin: float = 3.0
    """Time requested from a batch system relative to the estimate. With a larger value the job waits longer
    in the queue, with a smaller one it may be killed."""
    spare_minutes: int = 10
    """Time requested for every job in addition, for slow starts on a busy file server."""

    # jobs
    job_seconds: float = 60.0
    """Duration up to which short films share a job, since the start of a process, of a scheduler's job and of
    the libraries costs 2 to 6 s. A longer job loses more when it is killed."""
    jobs_per_core: int = 4
    """Jobs of short films per core, so that all cores finish together; fewer if the jobs would be shorter
    than `least_job_seconds`. More jobs cost more starts."""
    least_job_seconds: float = 20.0
    """Smallest duration of jobs that are split so that all cores finish together. Shorter jobs lose more to
    their start (3 s), longer ones leave cores idle at the end."""
    answer_s: float = DEFAULTS.answer_s
    """Longest wait, s, for a disk that does not answer while films are planned, watched or copied. A shorter
    time fails while a disk starts, a longer one waits for lost connections (tests/campaign/test_disks.py)."""

    # the page and the watched folder
    page_seconds: float = 3.0
    """Shortest interval between updates of index.html. It grows with the number of films, since the page
    reads a small file for each."""
    still_seconds: float = 10.0
    """A film in a watched folder is complete when it has not changed for this long. A shorter time may take a
    film whose camera pauses."""
    abandoned_seconds: float = 600.0
    """A film that is truncated or has no readable index is taken when it has not changed for this long, so
    that its damage is reported. A shorter time may take a film whose copying has stalled."""
    thumbnail_px: int = 220
    """Width of the pictures in index.html. Larger ones slow the page down with hundreds of films."""
