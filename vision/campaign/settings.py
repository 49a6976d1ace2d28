"""Every number that planning and running a campaign depends on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CampaignSettings:
    """Tunable constants of a campaign. `reports/campaign.py` measures what the estimates rest on."""

    # how long a film takes and what it needs, before anything of it was measured
    base_seconds: float = 1.0
    """Time for a film's tables, pictures and report, however short it is."""
    seconds_per_megasample: float = 0.7
    """Time for a million values of I(x,t), frames times columns: averaging, fits, identities, tables. It
    decides which films share a job and what a batch system is asked for; earlier films of the same campaign
    correct it."""
    seconds_per_gigapixel: float = 3.0
    """Time for reading and decoding: 1 to 4 s by the codec. It leads where frames are high."""
    base_memory_mb: float = 600.0
    """Libraries, figures and report."""
    memory_mb_per_megasample: float = 40.0
    """Memory for a million values of I(x,t), with the fits' blocks and the tables. Too small a value and a
    batch system ends the job, which then gets twice as much."""
    margin: float = 3.0
    """Time asked of a batch system over the estimate. Larger waits longer in its queue, smaller is cut."""
    spare_minutes: int = 10
    """What every job gets on top, for slow starts on a busy file server."""

    # jobs
    job_seconds: float = 60.0
    """Short films share a job until it takes so long: the start of a process, of a scheduler's job and of
    the libraries costs 2 to 6 s. Longer loses more when a job is killed."""
    jobs_per_core: int = 4
    """So many jobs for each core where that leaves each `least_job_seconds`, so that all cores end together.
    More jobs cost more starts."""
    least_job_seconds: float = 20.0
    """Jobs of short films are not made shorter than this for the sake of ending together. Shorter ones lose
    more to their start (3 s), longer ones leave a core idle at the end."""
    stalled_seconds: float = 300.0
    """A copy to a node's own disk that does not grow for so long has failed, and its film with it; the others
    go on. Shorter gives up where a file server is busy
    (test_a_copy_that_stalls_is_one_line_and_no_hang)."""

    # the page and the folder that is watched
    page_seconds: float = 3.0
    """index.html is written at most this often while films are done, and more rarely with hundreds of films,
    for it reads a small file of each."""
    still_seconds: float = 10.0
    """A film in a watched folder is complete when its size and time stood still for so long. Shorter may take
    one whose camera pauses."""
    abandoned_seconds: float = 600.0
    """A film whose index cannot be read, or which was cut, is taken when it stood still for so long: nobody
    writes it any more, and it should be named. Shorter may take one whose copying has stalled."""
    thumbnail_px: int = 220
    """Width of the pictures in index.html; larger ones make the page heavy where there are hundreds."""
