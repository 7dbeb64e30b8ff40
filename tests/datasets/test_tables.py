"""Tables of other programs: where they begin, what their columns are called, which cells are numbers."""

from __future__ import annotations

import gzip
import lzma

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from scipy.io import savemat

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import file_format, file_stem
from thermogrip.datasets.tables import (
    find_layout,
    parse_text,
    read_csv_table,
    read_matlab_table,
    read_parquet_table,
    read_text_table,
    unused,
)

NULLS = ["nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan", "#N/A"]
ONES = " ".join(50 * "1")
BY_POSITION = "no header: columns named c1 to c{} by position; --columns a,b,... names them"


def refusal(call, *given):
    with pytest.raises(UserError) as caught:
        call(*given)
    return str(caught.value)


def shown(table):
    """Return the columns as text, - for what is no number, and the lines of the rows."""
    cells = {name: [f"{v:g}".replace("nan", "-") for v in values] for name, values in table.numbers.items()}
    return {name: " ".join(values) for name, values in {**cells, **table.text}.items()}, table.lines.tolist()


@pytest.mark.parametrize(
    ("name", "kind", "stem"),
    [("a.b.CSV.gz", "csv", "a.b"), ("x.tsv", "text", "x"), ("x.dat.xz", "text", "x"), ("x.h5", "netcdf", "x"),
     ("x.pq", "parquet", "x"), ("x.mcap", "rosbag", "x"), ("x.Mat", "matlab", "x"), ("x.xlsx", "excel", "x"),
     ("x.gz", None, "x"), ("x.odt", None, "x"), ("x", None, "x")],
)  # fmt: skip
def test_the_ending_is_the_format_and_the_rest_is_the_name(name, kind, stem):
    assert file_stem(f"/some/{name}") == stem
    if kind:
        assert file_format(f"/some/{name}") == kind
    else:
        assert "is unknown; use one of .csv .csv.gz " in refusal(file_format, name)


@pytest.mark.parametrize(
    ("text", "names", "skip", "separator", "notes"),
    [
        ("1, 2\n3, 4\n", "c1|c2", 0, ",", BY_POSITION.format(2)),  # blanks would do as well
        ("1|2\n3|4\n", "c1|c2", 0, "|", BY_POSITION.format(2)),
        ("1;2,5\n3;4,5\n", "c1|c2", 0, ";", BY_POSITION.format(2)),
        ("1,5;2,5\n3,5;4,5\n", "c1|c2", 0, ";", BY_POSITION.format(2)),
        ("1\n2\n", "c1", 0, "\t", BY_POSITION.format(1)),
        ("x,y\nINF,Inf\n1,2\n", "x|y", 1, ",", ""),
        ("x,y\n٣,٤\n1,2\n", "٣|٤", 2, ",", "1 line(s) before the table passed over"),
        ("a,b,3\n1,2,3\n", "a|b|3", 1, ",", ""),
        ("t u v\n0.5\t1\n1.5\t2\n", "c1|c2", 1, "\t",
         BY_POSITION.format(2) + "; 1 line(s) before the table passed over"),
        ("a,b,\n1,2,\n3,4,\n", "a|b|\x1fend", 1, ",", ""),
        ("1,2,\n3,4,\n", "c1|c2|\x1fend", 0, ",", BY_POSITION.format(2)),
        ("a,b,\n1,2,\n3,4,5\n", "a|b|c3", 1, ",", "without a name: c3"),
        ("a,,,\n1,2,3,\n3,4,5,\n", "a|c2|c3|\x1fend", 1, ",", "without a name: c2, c3"),
        ("a,b,a\n1,2,3\n3,4,5\n", "a|b|2_a", 1, ",", "a occurs again: named 2_a"),
        ("x\n0,1,2\n1,2,3\n", "c1|c2|c3", 1, ",",
         BY_POSITION.format(3) + "; 1 line(s) before the table passed over"),
        ("Dev 1\n\n# c\nx,y\ns,V\n0,1\n1,2\n", "x [s]|y [V]", 5, ",",
         "1 line(s) before the table passed over"),
        ("v,w\nx,y\ns,V\n0,1\n1,2\n", "x [s]|y [V]", 3, ",", "1 line(s) before the table passed over"),
        ("% c\nx,y\n[s],(V)\n0,1\n1,2\n", "x [s]|y [V]", 3, ",", ""),
        ("x,y\n,V\n0,1\n1,2\n", "x|y [V]", 2, ",", ""),
        ("x,y\nfoo,V\n0,1\n1,2\n", "foo|V", 2, ",", "1 line(s) before the table passed over"),
        ("x,y\n# s,V\n0,1\n1,2\n", "x [s]|y [V]", 2, ",", ""),
        ("# x,y\n0,1\n1,2\n", "x|y", 1, ",", ""),
        ("q,r\n# x,y\n0,1\n1,2\n", "x|y", 2, ",", "1 line(s) before the table passed over"),
        ("// x y\n0 1\n1 2\n", "x|y", 1, " ", ""),
        ("Time s  Heater power\n0 1\n1 2\n", "Time s|Heater power", 1, " ", ""),
        ("# Time of day\tHeater\n0 1\n1 2\n", "Time of day|Heater", 1, " ", ""),
        ("Time of day, Heater\n0 1\n1 2\n", "Time of day|Heater", 1, " ", ""),
        ("\n'=x,\"y,1\"\n\n1,2\n3,4\n", "=x|y,1", 3, ",", ""),
        ("2026,1\nx,y\n3,4\n5,6\n", "x|y", 2, ",", "1 line(s) before the table passed over"),
        ("12\n1,2\n3,4\n", "c1|c2", 1, ",",
         BY_POSITION.format(2) + "; 1 line(s) before the table passed over"),
        ("channel names:\nHeater\tTank 1\ndt:\n0.5\t0.5\ndata:\n1\t2\n3\t4\n", "Heater|Tank 1", 5, "\t",
         "4 line(s) before the table passed over"),
        ("Nr,U,T\nNO.,%,degC\n1,2,3\n2,2,3\n", "Nr|U [%]|T [degC]", 2, ",", ""),
        ("t,n,U,T\nTS,RN,V,degC\n,,Avg,Avg\n1,2,3,4\n2,2,3,4\n", "t|n|U|T", 3, ",",
         "2 line(s) before the table passed over"),  # the line of most names, of Campbell's four
        ("N,U,N,T\nType,INT,Type,REAL\nSize,2,Size,8\n0,1,0,5\n1,2,1,5\n2,2,2,5\n", "N|U|2_N|T", 3, ",",
         "N occurs again: named 2_N; 2 line(s) before the table passed over"),
        ("Unit:;9;\nt;U;T\n1;0;5\n2;0;5\n", "t|U|T", 2, ";", "1 line(s) before the table passed over"),
        ("a,b,c\n1,x,\n2,,5\n", "a|b|c", 1, ",", ""),  # half of the cells
        ("a;b,c\n", "a;b|c", 1, ",", ""),
        ("Log\nversion\t2\nby\tme\n\nTime\tU\tT (C)\n" + "0\t1\t2\n" * 40, "Time|U|T (C)", 5, "\t",
         "3 line(s) before the table passed over"),
        ("a,b\n1,2\n", "a|b", 1, ",", ""),  # a row alone stands beside the header
        ("Time (s),Set,I (A)\n0\t1\t2\n1\t2\t3\n", "Time (s)|Set|I (A)", 1, "\t", ""),
        ("\t\t\tt\tU\tT\n0\t1\t2\n1\t2\t3\n", "t|U|T", 1, "\t", ""),
        ("data7 = [\n.1 2 3 4\n.2 2 3 4\n", "c1|c2|c3|c4", 1, " ",
         BY_POSITION.format(4) + "; 1 line(s) before the table passed over"),
        ("1,2,3,Oven,Time_(s)\n20,21,22,23,0\n20,21,22,23,12\n", "c1|c2|c3|c4|c5", 0, ",",
         BY_POSITION.format(5)),  # numbers of channels: asked about
        ("t,Heating,Cooling,T\n0,ON,OFF,22\n1,OFF,ON,22\n", "t|Heating|Cooling|T", 1, ",", ""),
        ("0,100,ERR,22\n1,100,23,22\n2,100,24,25\n", "c1|c2|c3|c4", 0, ",", BY_POSITION.format(4)),
        *((("x\n" * (198 + more) + "a,b\n0,1\n0,2\n"), *found, ",", note) for more, found, note in [
            (0, ("a|b", 199), "198 line(s) before the table passed over"), (1, ("x", 1), "")]),
    ],
)  # fmt: skip
def test_where_a_table_begins_and_what_its_columns_are_called(text, names, skip, separator, notes):
    layout = find_layout(text, "a.txt")
    assert ("|".join(layout.names), layout.skip, layout.separator) == (names, skip, separator)
    assert "; ".join(layout.notes) == notes


def rows(n, changed, head="a,b\n"):
    return head + "".join(changed.get(k, f"{k},{k + 0.5}\n") for k in range(n))


SHORT = {k: f"{k}\n" for k in range(3, 9)}
CELL = "write a number, leave the cell empty, or drop the column (- in --columns)"
LEFT = "row(s) with too few or too many cells left out"


@pytest.mark.parametrize(
    ("text", "noted", "refused"),
    [
        (rows(20, {3: "3\n"}), f"1 {LEFT} (row 5)", ""),
        (rows(19, {3: "3\n"}), "", "row 5: has 1 cell(s), the header has 2; complete or remove the row"),
        (rows(40, {3: "3\n", 7: "7,1,2\n"}), f"2 {LEFT} (rows 5, 9)", ""),
        (rows(39, {3: "3,1,2\n", 7: "7\n", 9: "9\n"}), "",
         "row 5: has 3 cell(s), the header has 2; 2 more rows do not fit; complete"),
        (rows(30, {3: "3,1,2\n", 7: "7\n"}), "",
         "the header has 2; 1 more rows do not fit; complete or remove the row"),
        (rows(20, {3: "3\n"}, "# c,d,e\na,b\n"), f"1 {LEFT} (row 6)", ""),
        (rows(120, SHORT), f"6 {LEFT} (rows 5, 6, 7, 8, 9, ...)", ""),
        (rows(100, {k: SHORT[k] for k in range(3, 8)}), f"5 {LEFT} (rows 5, 6, 7, 8, 9)", ""),
        (rows(20, {3: "3,x\n", 6: "4,y\n"}),
         "b: 2 cell(s) that are no numbers left empty (rows 5, 8: 'x')", ""),
        (rows(19, {3: "3,x\n", 6: "4,y\n"}), "", f"row 5, column b: 'x' is not a number; {CELL}"),
        (rows(11, {3: "3,x\n", 4: "4,\n"}), "b: 1 cell(s) that are no numbers left empty (row 5: 'x')", ""),
        (rows(10, {3: "3,x\n", 4: "4,?\n"}), "", "row 5, column b: 'x' is not a number"),
        ("a,b\n1,2\n3,\n4", "row 4 is the last and was cut off (1 of 2 cells): dropped", ""),
        ("a,b\n1,2\n\n\n5,warm\n6,7\n", "", "row 5, column b: 'warm' is not a number"),
        ('a,b\n1,2\n"3,4\n5,6\n', "", "row 3: has 1 cell(s), the header has 2; complete"),
        ("a,b\n1,1_0\n2,3\n", "", "'1_0' is not a number"),
        ("a,b\n1,2,5\n2,3,5\n", "", "2 names above rows of 3 cells; name all with --columns NAME,NAME"),
        ("a,b\n1,2,5,5\n2,3,5,1\n", "", "2 names above rows of 4 cells; name all with"),  # decimal commas
        ('"t" "u"\n"1" 0 5\n"2" 1 5\n', "", "has 2 names above rows of 3 cells"),  # as R writes row names
        (rows(9, {4: "b,a\n"}), "", "row 6: the header stands again with other columns: 'b,a'; cut the file"),
        ('a {"T":1,"U":2}\nb {"T":1}\n' * 9, "", "lines of several kinds are none)"),
        ("a,b\n1," + "x" * 40 + "\n2,3\n", "", f"'{'x' * 40}' is not a number"),
        ("a,b\n1," + "x" * 41 + "\n2,3\n", "", f"'{'x' * 37}...' is not a number"),
        ("a,b,c\n1,x,1\n2,y,1\n3,3,1\nz,4,1\n", "", f"row 5, column a: 'z' is not a number; {CELL}"),
        ("a,b\n" + "\n" * 3, "", "has a header but no rows; give at least two rows"),
    ],
)  # fmt: skip
def test_a_few_broken_rows_and_cells_are_left_out_and_more_of_them_refused(text, noted, refused):
    if refused:
        line = refusal(parse_text, text.encode(), "a.txt")
        assert refused in line
        assert line.endswith(refused) or not refused.endswith((" row", " place)"))
        return
    table = parse_text(text.encode(), "a.txt")
    assert table.notes == (noted,)
    lines = text.splitlines()
    assert [lines[at - 1].split(",")[0] for at in table.lines] == [f"{a:g}" for a in table.numbers["a"]]


def test_a_cell_with_a_line_end_is_one_row_that_has_its_first_line():
    table = parse_text(rows(80, {9: '9,"1\n1,"\n', 79: "79\n"}).encode(), "a.txt")
    assert table.lines.tolist() == [*range(2, 12), *range(13, 82)]
    np.testing.assert_array_equal(table.numbers["b"][8:11], [8.5, np.nan, 10.5])


def test_a_table_has_4096_columns_at_most():
    line = ",".join(["1"] * 4096)
    assert find_layout(f"{line}\n{line}\n", "a.txt").names[-1] == "c4096"
    for more in ("1", "x"):
        text = "\n".join([f"{line.replace('1', more)},{more}"] * 2)
        assert "4097 " in refusal(find_layout, text, "a.txt")


@pytest.mark.parametrize(
    ("text", "cells", "lines", "notes"),
    [
        ("a,b\n0,on\n1,OFF\n2,\n", {"a": "0 1 2", "b": "1 0 -"}, [2, 3, 4],
         ["b: words as 'on' read as 0 and 1"]),
        ("a,b\n0,No\n1,yes\n", {"a": "0 1", "b": "0 1"}, [2, 3], ["b: words as 'No' read as 0 and 1"]),
        ("a,b\n0,true\n1,FALSE\n", {"a": "0 1", "b": "1 0"}, [2, 3], ["b: words as 'true' read as 0 and 1"]),
        ("a,b\n0,on\n1,maybe\n", {"a": "0 1", "b": "on maybe"}, [2, 3], []),
        ("a,b\n" + "1,p\n" * 9 + "1,5\n", {"a": "1 " * 9 + "1", "b": "p " * 9 + "5"}, [*range(2, 12)], []),
        ("a,b\n0,1/2/2026\n1,7\n", {"a": "0 1", "b": "1/2/2026 7"}, [2, 3], []),
        ("a,b\n0,10:30\n1,7\n", {"a": "0 1", "b": "10:30 7"}, [2, 3], []),
        ("a;b;c\n1;2,5;x\n2;-3,5e2;y\n", {"a": "1 2", "b": "2.5 -350", "c": "x y"}, [2, 3],
         ["numbers have a decimal comma"]),
        ('a,b\n1,"2\n"\n3,4\n', {"a": "1 3", "b": "2 4"}, [2, 4], []),
        ('a,b\n"1,5","-2,5"\n2,3\n', {"a": "1.5 2", "b": "-2.5 3"}, [2, 3], ["numbers have a decimal comma"]),
        ("a;b\n0,5;+  1,5\n1.234,5;-  2,5\n", {"a": "0.5 1234.5", "b": "1.5 -2.5"}, [2, 3],
         ["numbers have a decimal comma", "numbers are as printed: a long minus, marks between thousands"]),
        ("a,b,Quality\n1,5,Good\n2,0,Bad\n3,6,Good\n",
         {"a": "1 2 3", "b": "5 0 6", "Quality": "Good Bad Good"}, [2, 3, 4],
         ["Quality does not call each reading good: leave those cells empty that it does not"]),
        ("a b\n1  2 \n\n3\t4\r\n", {"a": "1 3", "b": "2 4"}, [2, 4], []),
        ("a,b\n1,+.5e-3\n2,-Infinity\n3,\n4,7.\n", {"a": "1 2 3 4", "b": "0.0005 -inf - 7"},
         [2, 3, 4, 5], []),
        ("a,b\n1,5\n" + "".join(f"2,{w}\n" for w in ("-", "--", "---", "?", "*", "NaT")),
         {"a": "1 2 2 2 2 2 2", "b": "5 - - - - - -"}, [*range(2, 9)], []),
        ("a,b\n1,5\n" + "".join(f"2,{w}\n" for w in NULLS),
         {"a": "1" + " 2" * 10, "b": "5" + " -" * 10}, [*range(2, 13)], []),
        ("a,b\xb5\n1,2\n", {"a": "1", "b\xb5": "2"}, [2], []),
        (b"a,b\xb5\n1,2\n3,4\n", {"a": "1 3", "b\xb5": "2 4"}, [2, 3],
         ["text is not UTF-8: read as Windows-1252; if names look wrong, save it as UTF-8"]),
        ("a;b\n1;\u22122,5\n2;2\u202f400,0\n3;12'345,5\n", {"a": "1 2 3", "b": "-2.5 2400 12345.5"},
         [2, 3, 4],
         ["numbers are as printed: a long minus, marks between thousands", "numbers have a decimal comma"]),
    ],
)  # fmt: skip
def test_cells_are_numbers_switches_times_or_words(text, cells, lines, notes):
    table = parse_text(text if isinstance(text, bytes) else text.encode(), "a.txt")
    assert shown(table) == (cells, lines)
    assert list(table.notes) == notes


@pytest.mark.parametrize(
    ("text", "cells"),
    [
        ("PWM:1,T1:20.5,T2:-3e1\n" * 3, {"PWM": "1 1 1", "T1": "20.5 20.5 20.5", "T2": "-30 -30 -30"}),
        ("t = 0, T hot = nan\r\nt = 1, T hot = 5\r\n", {"t": "0 1", "T hot": "- 5"}),
        ("a:1\tb:2\na:3\tb:4\n", {"a": "1 3", "b": "2 4"}),
        ("a:1 b:2\n\na:3 b:4\n", {"a": "1 3", "b": "2 4"}),
        ('{"a":1,"b":2.5}\n{"a": 3, "b": 4}\n', {"a": "1 3", "b": "2.5 4"}),
        ("T: 21.5\u00b0C - duty = 40 %\n" * 2, {"T [\u00b0C]": "21.5 21.5", "duty [%]": "40 40"}),
    ],
)
def test_cells_that_begin_with_the_names_of_their_columns(text, cells):
    table = parse_text(text.encode(), "a.txt")
    assert shown(table)[0] == cells
    assert table.notes == (f"lines have readings beside their names: {', '.join(cells)}",)


def test_labels_must_be_alike_in_the_rows_and_differ_in_a_row():
    for text in ("a:1,b:2\nb:2,a:1\n", "a:1,a:2\n" * 3, "12:30,5\n12:31,6\n"):
        assert not any("begin with" in note for note in parse_text(text.encode(), "a.txt").notes)


def test_columns_are_named_anew_and_those_of_a_dash_left_out():
    for names, kept in ((["-", "x", "x"], {"x": "2 4", "x_2": "3 5"}), (["-", "-", "y"], {"y": "3 5"})):
        assert shown(parse_text(b"a,b,a\n1,2,3\n3,4,5\n", "a.txt", names))[0] == kept
    assert parse_text(b"1,2\n3,4\n", "a.txt", ["p", "q"]).notes == ()
    assert shown(parse_text(b"a,b,\n1,2,\n3,4,\n", "a.txt", ["p", "-"]))[0] == {"p": "1 3"}
    for names in (["p"], ["p", "q", "r"]):
        line = refusal(parse_text, b"a,b,\n1,2,\n3,4,\n", "a.txt", names)
        assert f"has 2 columns, --columns names {len(names)}; write a name for each, - to leave one" in line
    assert [unused("a", []), unused("a", ["a"]), unused("a", ["a", "a_2"])] == ["a", "a_2", "a_3"]


@pytest.mark.parametrize(
    ("text", "word", "found"),
    [
        ("# c\n\na,b\n1, x \n\n3,\n", "b", ({"a": "1 3", "b": "x "}, [4, 6])),
        ("a,b\n1,x\n3,'=y\n", "b", ({"a": "1 3", "b": "x =y"}, [2, 3])),
        ("a;b\tc\n1;2\n", "", ({"a": "1", "b\tc": "2"}, [2])),
        ("a\tb\n1\t2,5\n", "", ({"a": "1", "b": "2.5"}, [2])),
        ("a,b\n1,NA\n2,-\n3,1\n", "", ({"a": "1 2 3", "b": "- - 1"}, [2, 3, 4])),
        ("a,b\n" + "1,1\n" * 50 + "7", "", ({"a": ONES, "b": ONES}, [*range(2, 52)])),
        ("a,b\n" + "1,1\n" * 50 + "7\n", "", "row 52: has 1 cell(s), the header has 2"),
        ("a,b\n" + "1,1\n" * 50 + "7,x\n", "", "row 52, column b: 'x' is not a number"),
        ("a,b\n1,on\n2,off\n", "", "row 2, column b: 'on' is not a number"),
        ("a,b\n1,10:30\n2,1\n", "", "'10:30' is not a number; write seconds since the first row"),
        ("a;b,c\n1;2,5\n", "", "column a;b: '1;2' is not a number"),
        ("a,\n1,2\n", "", "row 1: column 2 has no name; name each column once"),
        ("#\nb,a,b\n1,2,3\n", "", "row 2: column 'b' occurs twice; name each column once"),
        (b"a\xff,b\n1,2\n", "", "row 1: is not UTF-8 text; save the file as UTF-8"),
        (b"a,b\n1,2\n\n3,\xff\n", "b", "not UTF-8 text; save"),
        (b"a,b\n1,2\n\0\n", "", "is not text, so it is not CSV; export it as comma-separated text"),
        (b"\x80a,b\n1,2\n", "", "is not text, so it is not CSV"),
    ],
)
def test_a_table_of_thermogrip_is_read_strictly(tmp_path, text, word, found):
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    if isinstance(found, str):
        assert found in refusal(lambda: read_csv_table(path, text=word.__eq__))
        return
    table = read_csv_table(path, text=word.__eq__)
    assert shown(table) == found
    assert [*table.text] == [*word]


A = np.arange(6.0)


@pytest.mark.parametrize(
    ("content", "found", "dt", "notes"),
    [
        ({"x": A, "y": A + 1, "z": A[:3]}, {"x": "0 1 2 3 4 5", "y": "1 2 3 4 5 6"}, "",
         ["left out, of another length: z"]),
        ({"x": A[:2], "y": A[1:3], "z": A[:3]}, {"x": "0 1", "y": "1 2"}, "",
         ["left out, of another length: z"]),  # 2 x 2 cells against 3
        ({"x": A[:2], "y": A[:2], "w": A[:4]}, {"w": "0 1 2 3"}, "",
         ["left out, of another length: x, y"]),
        ({"m": A.reshape(2, 3)}, {"c1": "0 1 2", "c2": "3 4 5"}, "", [BY_POSITION.format(2)]),
        ({"m": A[:4].reshape(2, 2)}, {"c1": "0 2", "c2": "1 3"}, "", [BY_POSITION.format(2)]),
        ({"m": A.reshape(3, 2), "n": A[:3]}, {"m_1": "0 2 4", "m_2": "1 3 5", "n": "0 1 2"}, "", []),
        ({"m": A.reshape(3, 2), "e": np.zeros((0, 3))}, {"c1": "0 2 4", "c2": "1 3 5"}, "",
         [BY_POSITION.format(2)]),
        ({"x": A[:2], "Ts": 0.5, "dt": 3}, {"x": "0 1"}, "0.5", []),
        ({"run": {"x": A[:2], "Ts": 0.5}, "title": "one"}, {"x": "0 1"}, "0.5", []),
        ({"x": A[:2], "ts": 0, "DT": 2}, {"x": "0 1"}, "2.0", []),
        ({"x": A[:2], "fs": 4}, {"x": "0 1"}, "0.25", []),
        ({"x": A[:2], "fs": -4}, {"x": "0 1"}, "", []),
        ({"x": A[:2], "a": {"b": {"c": {"d": {"y": A[2:4], "e": {"z": A[:2]}}}}}}, {"x": "0 1", "y": "2 3"},
         "", []),
        ({"x": A[:2] + 1j, "b": A[:2] > 0, "i": A[:2].astype(np.int8), "t": np.zeros((2, 2, 2)), "s": "text"},
         {"b": "0 1", "i": "0 1"}, "", []),
    ],
)  # fmt: skip
@pytest.mark.parametrize("packed", [True, False])
def test_arrays_of_a_matlab_file_are_columns(tmp_path, content, found, dt, notes, packed):
    savemat(tmp_path / "a.mat", content, do_compression=packed)
    table = read_matlab_table(tmp_path / "a.mat")
    n = len(next(iter(table.numbers.values())))
    assert shown(table) == (found, [*range(1, n + 1)])
    assert (table.meta, list(table.notes)) == ({"dt": dt} if dt else {}, notes)


def test_columns_of_a_matlab_file_may_be_named(tmp_path):
    savemat(tmp_path / "a.mat", {"m": A.reshape(2, 3)})
    assert shown(read_matlab_table(tmp_path / "a.mat", ["p", "-"]))[0] == {"p": "0 1 2"}
    line = refusal(read_matlab_table, tmp_path / "a.mat", ["p"])
    assert "a.mat: has 2 columns, --columns names 1; write" in line


def test_a_matlab_file_that_was_cut_off_or_is_of_no_byte_order_is_damaged(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"x": A, "y": A + 1})
    whole = path.read_bytes()
    assert whole[126:128] == b"IM"
    for data in (whole[:-1], whole[:-8], whole[:126] + b"XX" + whole[128:]):
        path.write_bytes(data)
        assert "is no MATLAB file, or is damaged (" in refusal(read_matlab_table, path)


def test_a_parquet_file_is_its_columns_with_what_is_said_of_them(tmp_path):
    path = tmp_path / "a.parquet"
    fields = [pa.field("t", pa.int32(), metadata={"units": "s"}), pa.field("b", pa.bool_())]
    columns = [pa.array([3, 4, None], pa.int32()), pa.array([True, False, True])]
    parquet.write_table(pa.table(columns, schema=pa.schema(fields, metadata={"schema": "x"})), path)
    table = read_parquet_table(path)
    assert shown(table) == ({"t": "3 4 -", "b": "1 0 1"}, [1, 2, 3])
    assert (table.attrs["t"]["units"], "units" in table.attrs["b"], table.meta["schema"]) == ("s", False, "x")
    parquet.write_table(pa.table({"t": [1.0], "word": ["a"], "state": ["on"]}), path)
    assert shown(read_parquet_table(path))[0] == {"t": "1", "state": "1", "word": "a"}
    parquet.write_table(pa.table({"t": [[1.0]]}), path)
    assert "column t: holds list<element: double>; leave it out" in refusal(read_parquet_table, path)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.csv", b"a,a\n1,2\n", "occurs twice"),
        ("a.csv.gz", gzip.compress(b"a,a\n", mtime=0), "occurs twice"),
        ("a.csv.xz", lzma.compress(b"\0\1"), "is not text"),
        ("a.csv.gz", b"no", "is damaged or not compressed as its name says (BadGzipFile"),
        ("a.csv", b" \n \n", "is empty; give a header and at least two rows"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, name, data, said):
    (tmp_path / name).write_bytes(data)
    assert said in refusal(read_csv_table, tmp_path / name)


def test_utf_16_text_is_read_and_is_refused_where_it_ends_within_a_letter(tmp_path):
    path = tmp_path / "b.csv"
    path.write_bytes("a,b\n1,2\n".encode("utf-16"))
    assert shown(read_csv_table(path)) == ({"a": "1", "b": "2"}, [2])
    path.write_bytes(path.read_bytes()[:-1])
    assert "is damaged UTF-16 text; save it as UTF-8" in refusal(read_csv_table, path)


def test_names_that_are_more_than_the_cells_are_not_given_to_them(tmp_path):
    path = tmp_path / "a.csv"
    for n in (3, 6):
        rows = "".join(",".join(f"{k % (7 + place)}.5" for place in range(n)) + "\n" for k in range(30))
        path.write_text(f"time,round,output,temperature\n{rows}")
        table = read_text_table(path)
        assert list(table.numbers) == [f"c{place}" for place in range(1, n + 1)]
        assert table.notes[0].startswith(f"4 names above rows of {n} cells: columns named c1 to c{n}")
