"""The sample: two interleaved blocks of sheets."""

from __future__ import annotations

from dataclasses import dataclass

from vision.errors import Positive, PositiveInt, check_fields


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Geometry and adhesion of one sample; the defaults are the publication's.

    Raises
    ------
    InputError
        For a number that is not positive and finite, or a number of sheets that is not an integer.

    Notes
    -----
    Source: publication, sections II (samples) and III (model).
    """

    # M, number of sheets of one block on each side of the symmetry axis; the block has 2M.
    sheets_per_block: PositiveInt = 25
    thickness_mm: Positive = 0.1  # ε, of one sheet
    width_mm: Positive = 45.0  # W, of the sheets
    length_mm: Positive = 57.0  # L, of the sheets from the clamp to their end
    t_star_N: Positive = 0.003  # T*, traction on the outermost sheet due to adhesion

    def __post_init__(self) -> None:
        check_fields(self)


PUBLISHED = Sample()
"""The publication's sample."""

LEAST_GPA, MOST_GPA = 0.1, 30.0
LEAST_MU, MOST_MU = 0.05, 3.0  # friction of polytetrafluoroethylene, and of rubber


def is_plausible_modulus(modulus_GPa: float) -> bool:
    """Return whether sheets may have this modulus: paper and films of polymers have 0.1 to 30 GPa.

    A wrong unit of a length or a force changes it by 10 times or more. Metals and rubber are doubted, too.
    """
    return LEAST_GPA < modulus_GPa < MOST_GPA
