"""Tables of forces as devices and spreadsheets write them: the right times and newtons, or a refusal."""

from pathlib import Path

import numpy as np
import pytest
from fake_recording import Maker

from bench.recording.recording_folder import open_recording
from bench.recording.sensor_table import POUND, G, read_forces
from synth.errors import UserError
from synth.system import csv_table

T = 0.002 * np.arange(200)
F = np.stack([0 * T + 0.25, -0.5 * np.sin(np.pi * T / 0.4) ** 2, 0 * T + 2], axis=1)
DAY_S = 1_795_824_000.0  # 2026-11-28


def rows(cells: object, mark: str = ",") -> str:
    return "".join(mark.join(map(str, row)) + "\n" for row in cells)


def plain(mark: str = ",", form: str = "{:.6f}") -> str:
    return rows(([form.format(x) for x in (t, *f)] for t, f in zip(T, F, strict=True)), mark)


def clock(form: str) -> str:
    return rows([form.format(s=t, m=2, h=10), *f] for t, f in zip(T, F, strict=True))


LVM = "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\nChannels\t3\n***End_of_Header***\n"
TABLES = {
    "head lines": "Calibration:,FT1\nForce units:,N\nSample rate:,500\n\nTime,Fx,Fy,Fz\n" + plain(),
    "lvm": LVM + "X_Value\tFx\tFy\tFz\tComment\n" + plain("\t"),
    "lvm without times": LVM + "Delta_X\t0.002\nFx\tFy\tFz\n" + rows(F, "\t"),
    "rate in the head": "Sample Rate (kHz): 0.5\n".replace("(kHz): 0.5", ": 0.5 kHz")
    + "Fx,Fy,Fz\n"
    + rows(F),
    "comments": "# nano17\n% tare\nt_s,fx_n,fy_n,fz_n\n" + plain(),
    "header as a comment": "# t fx fy fz\n" + plain(" "),
    "comments in between": "t_s,fx_n,fy_n,fz_n\n" + plain().replace("\n", "\n# pause\n", 1),
    "row of units": "Time,Fx,Fy,Fz\ns,N,N,N\n" + plain(),
    "spaces": "t_s fx_n fy_n fz_n\n" + plain("   "),
    "spaces and brackets": "time [s]  Fx (N)  Fy (N)  Fz (N)\n" + plain("   "),
    "Fortran": "t_s,fx_n,fy_n,fz_n\n" + plain(form="{:.9e}").replace("e", "D"),
    "torques first": "time,mx,my,mz,fx,fy,fz\n" + rows([t, 9, 9, 9, *f] for t, f in zip(T, F, strict=True)),
    "a counter": "t,timestamp,Fx,Fy,Fz\n" + rows([k, t, *F[k]] for k, t in enumerate(T)),
    "counters of one name": "time,time,t,timestamp,Fx,Fy,Fz\n"
    + rows([k, k, k, t, *F[k]] for k, t in enumerate(T)),
    "bars": "t_s|fx_n|fy_n|fz_n\n" + plain("|"),
    "commas at the ends": "t_s,fx_n,fy_n,fz_n,\n" + plain().replace("\n", ",\n"),
    "a comment at the end": "t_s,fx_n,fy_n,fz_n\r\n" + plain().replace("\n", "\r\n") + "# end\n",
    "raw values too": "t,fx_raw,fy_raw,fz_raw,fx,fy,fz\n"
    + rows([t, 9, 9, 9, *f] for t, f in zip(T, F, strict=True)),
    "paths of topics": "__time,/ft/wrench/force/x,/ft/wrench/force/y,/ft/wrench/force/z\n" + plain(),
    "German": "Zeit [s];Kraft x [N];Kraft y [N];Kraft z [N]\n" + plain(";").replace(".", ","),
    "quotes around all": '"t_s","fx_n","fy_n","fz_n"\n'
    + "".join(f'"{line}"\n' for line in plain('","').splitlines()),
    "decimal commas": "t_s;fx_n;fy_n;fz_n\n" + plain(";").replace(".", ","),
    "tabs and commas": "t_s\tfx_n\tfy_n\tfz_n\n" + plain("\t").replace(".", ","),
    "names of another order": "t_ms,Force Z (N),Force Y (N),Force X (N)\n"
    + rows([1000 * t, *f[::-1]] for t, f in zip(T, F, strict=True)),
    "MATLAB": "time,x force,y force,z force\n" + plain(),
}


@pytest.mark.parametrize("name", TABLES)
def test_three_axes_are_read_with_their_times(name: str, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(TABLES[name])
    table = read_forces(tmp_path / "f.csv")
    np.testing.assert_allclose(table.time_s, T, atol=1e-9)
    np.testing.assert_allclose(table.force, F, atol=1e-6)
    assert table.axes == "xyz"


@pytest.mark.parametrize(
    ("form", "start"),
    [
        ("{h}:{m:02d}:{s:06.3f}", 36_120.0),
        ("{h}:{m:02d}:{s:06.3f} PM", 79_320.0),
        ("11/28/2026 {h}:{m:02d}:{s:06.3f} AM", DAY_S + 36_120),
        ("28.11.2026 {h}:{m:02d}:{s:06.3f}", DAY_S + 36_120),
        ("28/11/2026 {h}:{m:02d}:{s:06.3f}", DAY_S + 36_120),
        ("2026/11/28 {h}:{m:02d}:{s:06.3f}", DAY_S + 36_120),
        ("28-Nov-2026 {h}:{m:02d}:{s:06.3f}", DAY_S + 36_120),
        ("2026-11-28T{h}:{m:02d}:{s:06.3f}+02:00", DAY_S + 28_920),
        ("05/06/2026 {h}:{m:02d}:{s:06.3f}", 36_120.0),  # June or May: counted from that day's start
    ],
)
def test_clocks_of_every_kind(form: str, start: float, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("Time,Fx,Fy,Fz\n" + clock(form))
    table = read_forces(tmp_path / "f.csv")
    np.testing.assert_allclose(table.time_s, start + T, atol=2e-6, rtol=0)


@pytest.mark.parametrize("unit", ["hh:mm:ss.fff", "UTC"])
def test_the_format_of_a_clock_is_no_unit(unit: str, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(f"Time [{unit}],Fx,Fy,Fz\n" + clock("{h}:{m:02d}:{s:06.3f}"))
    np.testing.assert_allclose(read_forces(tmp_path / "f.csv").time_s, 36_120 + T, atol=2e-6, rtol=0)


def test_a_clock_in_an_unknown_unit_gives_way_to_another(tmp_path: Path) -> None:
    cells = rows([10 * t, t, *f] for t, f in zip(T, F, strict=True))
    (tmp_path / "f.csv").write_text("time [0.1 s],elapsed [s],fx,fy,fz\n" + cells)
    np.testing.assert_allclose(read_forces(tmp_path / "f.csv").time_s, T)


@pytest.mark.parametrize(("day", "ambiguous"), [("05/06/2026", 1), ("05/28/2026", 0), ("05/05/2026", 0)])
def test_ambiguous_dates_with_am_and_pm_are_said(day: str, ambiguous: int, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("Time,Fx,Fy,Fz\n" + clock(day + " {h}:{m:02d}:{s:06.3f} AM"))
    table = read_forces(tmp_path / "f.csv")
    month_first = np.datetime64(f"2026-{day[:2]}-{day[3:5]}", "s").astype(int) + 36_120
    np.testing.assert_allclose(table.time_s, month_first + T, atol=2e-6, rtol=0)
    unambiguous_file = tmp_path / "clear.csv"
    unambiguous_file.write_text("Time,Fx,Fy,Fz\n" + clock("2026-05-06 {h}:{m:02d}:{s:06.3f} AM"))
    assert len(table.notes) - len(read_forces(unambiguous_file).notes) == ambiguous


def test_clocks_that_turn_dates_apart_days_and_blocks(tmp_path: Path) -> None:
    file = tmp_path / "f.csv"
    file.write_text("time,fx,fy,fz\n23:59:59.9,1,2,3\n00:00:00.1,1,2,3\n")
    assert np.diff(read_forces(file).time_s) == pytest.approx([0.2])
    file.write_text("date,time,fx,fy,fz\n2026-11-28,23:59:59.9,1,2,3\n2026-11-29,00:00:00.1,1,2,3\n")
    assert read_forces(file).time_s == pytest.approx([DAY_S + 86_399.9, DAY_S + 86_400.1], abs=1e-5)
    # The clock that the pictures have is taken, if there are several.
    cells = rows([f"2026-11-28 10:02:{t:06.3f}", t, *f] for t, f in zip(T, F, strict=True))
    file.write_text("time,elapsed,fx,fy,fz\n" + cells)
    np.testing.assert_allclose(read_forces(file).time_s, T)
    np.testing.assert_allclose(
        read_forces(file, since_1970=True).time_s, DAY_S + 36_120 + T, atol=1e-5, rtol=0
    )
    file.write_text("Time,Fx,Fy,Fz\n" + rows([f"{46354.25 + t / 86400:.10f}", *F[0]] for t in T))
    np.testing.assert_allclose(read_forces(file).time_s, DAY_S + 21_600 + T, atol=1e-4, rtol=0)
    # Eight samples share the stamp of their arrival.
    file.write_text("t_s,fx,fy,fz\n" + rows([0.016 * (k // 8 + 1), *F[k]] for k in range(200)))
    np.testing.assert_allclose(read_forces(file).time_s, T + 0.002, atol=1e-9)
    # A few repeated stamps are no blocks.
    file.write_text("t_s,fx,fy,fz\n" + rows([k - (k in (50, 90)), *F[k]] for k in range(200)))
    assert read_forces(file).time_s[50] == 49


@pytest.mark.parametrize(
    ("unit", "newtons"),
    [
        ("mN", 1e-3),
        ("gf", G),
        ("g", G),
        ("lbf", POUND),
        ("kg", 1000 * G),
        ("Newton", 1),
        ("cN", 0.01),
        ("µN", 1e-6),
    ],
)
def test_units_in_names_are_converted(unit: str, newtons: float, tmp_path: Path) -> None:
    for head in (f"time,Fx ({unit}),Fy [{unit}],Fz_{unit}\n", f"time,Fx,Fy,Fz\ns,{unit},{unit},{unit}\n"):
        (tmp_path / "f.csv").write_text(head + plain())
        table = read_forces(tmp_path / "f.csv")
        np.testing.assert_allclose(table.force, newtons * F, atol=1e-6 * newtons)
        assert table.in_newtons


@pytest.mark.parametrize(
    ("header", "axes", "place"),
    [
        ("time_s,force_n", "", 0),
        ("Time (s),Force (N)", "", 0),
        ("t,load", "", 0),
        ("t_s,f_n", "", 0),
        ("t_s,fz_n", "z", 2),
        ("t,Fx [N]", "x", 0),
    ],
)
def test_one_axis_or_a_size(header: str, axes: str, place: int, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(
        header + ",other\n" + rows([t, f[1], 7] for t, f in zip(T, F, strict=True))
    )
    table = read_forces(tmp_path / "f.csv")
    assert table.axes == axes
    np.testing.assert_allclose(table.force[:, place], F[:, 1])
    assert not np.delete(table.force, place, 1).any()


def test_the_table_of_a_testing_machine(tmp_path: Path) -> None:
    """A title, and units in a quoted row of their own."""
    cells = "".join(f'"{t:.3f}","0.1","{f[1]:.6f}"\n' for t, f in zip(T, F, strict=True))
    (tmp_path / "f.csv").write_text('Results\n"Time","Extension","Load"\n"(sec)","(mm)","(lbf)"\n\n' + cells)
    table = read_forces(tmp_path / "f.csv")
    np.testing.assert_allclose(table.force[:, 0], POUND * F[:, 1], atol=1e-5)


def test_columns_can_be_named(tmp_path: Path) -> None:
    file = tmp_path / "f.csv"
    file.write_text("made by a device\n" + plain())
    np.testing.assert_allclose(read_forces(file, "t_s,fx_n,fy_n,fz_n").force, F, atol=1e-6)
    table = read_forces(file, "t_s,-,f_mn")
    assert table.axes == ""
    np.testing.assert_allclose(table.force[:, 0], F[:, 1] / 1000, atol=1e-9)


@pytest.mark.parametrize(
    ("head", "hertz"),
    [
        ("Sampling rate: 1,000 Hz", 1000),
        ("Sample rate 1e3 Hz", 1000),
        ("Sampling rate [1/s]: 500", 500),
        ("Sampling rate (approx.) 1000 Hz", 1000),
        ("Sample Rate (kHz): 0.5", 500),
        ("Sample rate of FT300 = 0,5 kHz", 500),
        ('"Sample rate","1,000",,', 1000),
        ("Sample rate,500,500", 500),
        ("Sampling rate mode: auto\nSampling rate: 500.", 500),
        ("Delta_X\t0.002\t0.002", 500),
        ("Delta_X: 2e-3", 500),
    ],
)
def test_the_rate_in_a_head(head: str, hertz: float, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(f"{head}\nFx;Fy;Fz\n" + rows(F, ";"))
    np.testing.assert_allclose(read_forces(tmp_path / "f.csv").time_s, np.arange(200) / hertz)


@pytest.mark.parametrize(
    "head",
    [
        "Delta_X: e",
        "Delta_X: -0.002",
        "Sampling rate: 500 Hz, filter 100 Hz",
        "Sampling rate: 1 000 Hz",
        "Sample rate,500,250",
        "Sampling rate: 500\nSampling rate: 250",
        "Sampling rate: 2 ms",
        "Sampling rate: 1e999",
        "Sampling rate: 1,00 0,00.5",
        "Sampling rate: 500,500",
        "Sampling rate: 250,500 Hz",
        "Sampling rate: 500,1000",
    ],
)
def test_a_rate_that_cannot_be_told_is_refused(head: str, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(f"{head}\nFx;Fy;Fz\n" + rows(F, ";"))
    with pytest.raises(UserError):
        read_forces(tmp_path / "f.csv")


REFUSED = {
    "no header": plain(),
    "counts": "t,Fx (counts),Fy (counts),Fz (counts)\n" + plain(),
    "units that are missing of one axis": "t,Fx (mN),Fy (mN),Fz\n" + plain(),
    "two sensors": "t,left.fx,left.fy,left.fz,right.fx,right.fy,right.fz\n"
    + rows([t, *f, *f] for t, f in zip(T, F, strict=True)),
    "a row of text": "t,fx,fy,fz\n" + plain() + "mean,1,2,3\n",
    "no times": "fx,fy,fz\n" + rows(F),
    "cells too many": "t,fx,fy,fz\n0,5,1,2,3,4,5,6\n",
    "a row that is cut off": "t,fx,fy,fz,other\n0,1,2,3,4\n1,1,2\n",
    "a row of one cell": "t,fx,fy,fz,other\n0,1,2,3,4\n1\n",
    "a thousand or not": "t;fx;fy;fz\n1,482;2,111;3,222;4,333\n",
    "a frame's time code": "t,fx,fy,fz\n10:02:00:12,1,2,3\n10:02:00:13,1,2,3\n",
    "dates in either order": "t,fx,fy,fz\n01/02/2026 10:00:00,1,2,3\n01/04/2026 10:00:00,1,2,3\n",
    "minutes beyond": "t,fx,fy,fz\n10:72:00,1,2,3\n",
    "tenths of a second": "time [0.1 s],fx,fy,fz\n" + plain(),
    "ticks in a row of units": "time,fx,fy,fz\nticks,N,N,N\n" + plain(),
    "a spreadsheet": "PK\x03\x04\0\0\0",
}


def test_a_row_may_lack_what_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("t,fx,fy,fz,other\n0,1,2,3,4\n1,1,2,3\n")
    assert read_forces(tmp_path / "f.csv").force.tolist() == [[1, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_told_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(REFUSED[name])
    with pytest.raises(UserError):
        read_forces(tmp_path / "f.csv")


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (['"900"', '"1,000"', '"1,482"'], [900, 1000, 1482]),
        (['"1,482.5"', '"-12,003.25"', "7"], [1482.5, -12003.25, 7]),
        (['"1,482,000"', "5", "6"], [1482000, 5, 6]),
        (['"0,482"', '"1,482"', '"2,5"'], [0.482, 1.482, 2.5]),
        (['"1.482,5"', '"1.482"', '"-3,25"'], [1482.5, 1482, -3.25]),
        (["1'482.5", "1\u202f482", "nan"], [1482.5, 1482, np.nan]),
        (['"1,482"', '"12.5"', ""], [1482, 12.5, np.nan]),
    ],
)
def test_thousands_and_decimals_are_told_apart(
    cells: list[str], expected: list[float], tmp_path: Path
) -> None:
    (tmp_path / "t.csv").write_text("t_s,x\n" + "".join(f"{k},{cell}\n" for k, cell in enumerate(cells)))
    np.testing.assert_array_equal(csv_table.read_csv(tmp_path / "t.csv", ("t_s", "x"))["x"], expected)


@pytest.mark.parametrize("cells", [['"1,482"', '"2,111"'], ['"0,5"', '"1,482.5"'], ['"1,48,2.5"', '"2.5"']])
def test_numbers_that_may_be_two_are_refused(cells: list[str], tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t_s,x\n" + "".join(f"{k},{cell}\n" for k, cell in enumerate(cells)))
    with pytest.raises(UserError):
        csv_table.read_csv(tmp_path / "t.csv", ("t_s", "x"))


@pytest.mark.parametrize(("header", "component"), [("t_s,f_n", 0), ("t_s,fz_n", 2)])
def test_a_recording_with_a_load_cell_is_scored_by_size(make: Maker, header: str, component: int) -> None:
    folder = make(frames=3)
    (folder / "force.csv").write_text(header + "\n0,0\n0.1,0.3\n0.2,-0.1\n")
    recording = open_recording(folder)
    assert recording.force.force_mn[:, component].tolist() == [0, 300, -100]
    assert not recording.meta.sensor.in_camera_axes
    (folder / "force.csv").write_text("t_s,force\n0,0\n0.1,0.3\n")
    with pytest.raises(UserError):  # in which unit?
        open_recording(folder)
