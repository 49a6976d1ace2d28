"""One short recording in every layout that testing machines write."""

from __future__ import annotations

from pathlib import Path

import numpy as np

TIME = np.arange(40) * 0.1
LOAD = 20 + np.arange(40) * 0.5
PULL = np.arange(40) * 0.002


def rows(*columns: np.ndarray, sep: str = "\t", decimal: str = ".", quote: str = "") -> str:
    lines = [sep.join(f"{quote}{value:.6f}{quote}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join(lines).replace(".", decimal) + "\n"


MTS = (
    "File Path: C:\\DAQ- Crosshead, … - (Timed).txt\n"
    "Test: MTS EM Tension (Simplified) with Video Extensometer 5\n"
    "Test Run: 3\nDate: 1/10/2022 12:52:17 PM\n\n\n"
    "Crosshead \tLoad \tTime \tStrain 1 \tVideo Time \t\nmm\tN\tsec\tmm/mm\tsec\n"
) + rows(PULL, LOAD, TIME, TIME * 0 - 5.38e-6, 0.999958 * TIME + 8.0853)
MTS_CSV = '"Crosshead ","Load ","Time "\n"mm","N","sec"\n' + rows(PULL, LOAD, TIME, sep=",")
MTS_FRENCH = "Traverse \tForce \tTemps \t\nmm\tN\ts\n" + rows(PULL, LOAD, TIME, decimal=",")
MPT_HEAD = "Datum\tLaufzeit\tCh 1 Kraft Sollwert\tCh 1 Kraft\tCh 1 Weg\nd\ts\tkN\tkN\tmm\n"
MPT_BLOCK = "\nDatenerfassung\t\t\t\t\t\tZeit:\t544,35547\ts\t22.07.2014 07:28:27\n" + MPT_HEAD
DAYS = np.full(20, 41842.0)
MPT = (
    "MTS793|MPT|DEU|1|2|,|.|:|49|1|1|A\n"
    + MPT_BLOCK
    + rows(DAYS, TIME[:20], LOAD[:20] / 900, LOAD[:20] / 1e3, PULL[:20], decimal=",")
    + "\nSpitzenwerte\nZyklus\tMax Kraft\n-\tkN\n"
    + rows(TIME[:5], TIME[:5], decimal=",")
    + MPT_BLOCK
    + rows(DAYS, TIME[20:], LOAD[20:] / 900, LOAD[20:] / 1e3, PULL[20:], decimal=",")
)
INSTRON = 'Maximum Load : Maximum Load,"131.18347",lbf\n\nTime,Extension,Load\n(s),(in),(lbf)\n' + rows(
    TIME, PULL / 25.4, LOAD / 4.4482216152605, sep=",", quote='"'
)
INSTRON_UNIVERSAL = "Time;Displacement;Force\n(s);(mm);(kN)\n" + rows(
    TIME, PULL, LOAD / 1e3, sep=";", decimal=","
)
ZWICK = (
    '"Épaisseur éprouvette",1,"mm"\n"Temps","Traverse absolue","Force standard","Course standard"\n'
    '"s","mm","N","mm"\n'
) + rows(TIME, PULL - 794.864, LOAD, PULL, sep=",")
SPANISH = "Tiempo (ms);Fuerza (kgf);Desplazamiento (µm)\n" + rows(
    TIME * 1e3, LOAD / 9.80665, PULL * 1e3, sep=";", decimal=","
)
SNAKE = "time_s,load_mN,crosshead_cm\n" + rows(TIME, LOAD * 1e3, PULL / 10, sep=",")
SPACES = "# t / min   Kraft in N   Weg / m\n" + rows(TIME / 60, LOAD, PULL / 1e3, sep="   ")
TRAPEZIUM = (
    '"Name","Peter"\n"Date","2022/01/10"\n\n"1 _ 1","",""\n"Time","Force","Stroke"\n"sec.","N","mm"\n'
) + rows(TIME, LOAD, PULL, sep=",", quote='"')
LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nDate\t2022/01/10\n***End_of_Header***\t\n"
    "\t\nChannels\t2\t\nSamples\t40\t40\t\nTime\t12:52:17\t12:52:17\t\nY_Unit_Label\tkN\tcm\t\n"
    "X_Dimension\tTime\tTime\t\nDelta_X\t0,100000\t0,100000\t\n***End_of_Header***\t\t\t\n"
    "X_Value\tKraft\tWeg\tComment\n"
) + rows(TIME, LOAD / 1e3, PULL / 10, decimal=",")


def labview(*columns: np.ndarray, x: str, clock: str = "12:52:17,25", tags: str = "", start: str = "") -> str:
    """A segment of a LabVIEW file with times in "One" column, in "Multi" or in "No"."""
    gap = "\t\t" if x == "Multi" else "\t"  # a column of X_Value before each channel

    def line(tag: str, *cells: str) -> str:
        return tag + "\t" + gap.join(cells) + "\t\n"

    time, load, pull = columns
    named = {"One": (time, load, pull), "Multi": (time, load, time, pull), "No": (load, pull)}[x]
    values = rows(*named, decimal=",")
    return (
        (start or "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nMulti_Headings\tYes\n")
        + f"X_Columns\t{x}\nDate\t2022/01/09\nTime\t08:00:00\n***End_of_Header***\t\n\t\n" * (not start)
        + line("Channels", "2")
        + line("Samples", str(len(load)), str(len(load)))
        + line("Date", "2022/01/10", "2022/01/10")
        + line("Time", clock, clock)
        + tags
        + line("X0", "0,0000000000000000E+0", "0,0000000000000000E+0")
        + line("Delta_X", "0,100000", "0,100000")
        + "***End_of_Header***\t\t\t\n"
        + ("X_Value\tForce\tX_Value\tPosition" if x == "Multi" else "X_Value\tForce\tPosition")
        + "\tComment\n"
        + ("\t" + values.rstrip("\n").replace("\n", "\n\t") + "\n" if x == "No" else values)
    )


def labview_segments(x: str, *, pause_s: float = 0.0) -> str:
    """Two segments whose times begin again from 0, and whose stamps tell when they begin."""
    text = ""
    for k in range(2):
        part = slice(20 * k, 20 * (k + 1))
        second = f"{17.25 + k * (2 + pause_s):09.6f}".replace(".", ",")
        begin = "\n" if k else ""
        text += labview(TIME[:20], LOAD[part], PULL[part], x=x, clock=f"12:52:{second}", start=begin)
    return text


LABVIEW_UNITS = "Y_Unit_Label\tkN\t\tcm\t\nX_Dimension\tTime\t\tTime\t\n"
UNITS_ABOVE = "min;kN;cm\nTime;Load;Position\n" + rows(TIME / 60, LOAD / 1e3, PULL / 10, sep=";")
UNITS_ALONE = "when;channel 1;channel 2\ns;N;mm\n" + rows(TIME, LOAD, PULL, sep=";")
_SWAP = str.maketrans(",.", ".,")
GROUPED = "Prüfzeit;Standardkraft;Traversenweg\ns;mN;mm\n" + "".join(
    f"{t:.4f};{1e3 * f:,.2f};{x:.5f}\n".translate(_SWAP) for t, f, x in zip(TIME, LOAD, PULL, strict=True)
)

LAYOUTS = {
    "mts": (MTS, "utf-8-sig", "\r\n"),
    "mts-utf16": (MTS, "utf-16", "\r\n"),
    "mts-csv": (MTS_CSV, "utf-8", "\n"),
    "mts-french": (MTS_FRENCH, "utf-8-sig", "\r\n"),
    "mpt": (MPT, "latin-1", "\r\n"),
    "instron": (INSTRON, "utf-8", "\n"),
    "instron-universal": (INSTRON_UNIVERSAL, "utf-8", "\r\n"),
    "zwick": (ZWICK, "latin-1", "\r\n"),
    "spanish": (SPANISH, "latin-1", "\n"),
    "trapezium": (TRAPEZIUM, "utf-8", "\r\n"),
    "labview": (LABVIEW, "utf-8", "\r\n"),
    "labview-one": (labview(TIME, LOAD, PULL, x="One"), "utf-8", "\r\n"),
    "labview-multi": (labview(TIME, LOAD, PULL, x="Multi"), "utf-8", "\n"),
    "labview-no": (labview(TIME, LOAD, PULL, x="No"), "utf-8", "\r\n"),
    "labview-units": (
        labview(TIME, LOAD / 1e3, PULL / 10, x="Multi", tags=LABVIEW_UNITS),
        *("utf-8", "\r\n"),
    ),
    "labview-segments": (labview_segments("One"), "utf-8", "\r\n"),
    "labview-segments-no": (labview_segments("No"), "utf-8", "\r\n"),
    "units-above": (UNITS_ABOVE, "utf-8", "\n"),
    "units-alone": (UNITS_ALONE, "utf-8", "\n"),
    "thousands": (GROUPED, "latin-1", "\r\n"),
    "snake": (SNAKE, "utf-8", "\n"),
    "spaces": (SPACES, "utf-8", "\n"),
}


def written(
    folder: Path, text: str, encoding: str = "utf-8", newline: str = "\n", name: str = "test.txt"
) -> Path:
    path = folder / name
    path.write_bytes(text.replace("\n", newline).encode(encoding, errors="replace"))
    return path
