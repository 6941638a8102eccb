"""Exports to DuckDB: the tables that docs/beside-other-tools.md recommends select the same rows as NumPy."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pytest

import nedbus
from nedbus_msgs.arrays import MessageArray
from tests.flights.messages import VLP
from tests.flights.ulogs import LOGS

from .test_alignment import array_of, write

PAGE: Final = Path(__file__).parents[3] / "docs" / "beside-other-tools.md"
TYPES: Final = {"f4": "FLOAT", "f8": "DOUBLE"}
LARGEST: Final = float(np.finfo(np.float32).max)
SMALLEST: Final = float(np.finfo(np.float32).smallest_subnormal)
VALUES: Final = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -0.0,
    0.1,
    -0.1,
    1 / 3,
    SMALLEST,
    LARGEST,
    -LARGEST,
    5.0,
    2.0**24,
)
LIMITS: Final = (*VALUES[1:], 0.3, 2.0**24 + 1)

_Column = npt.NDArray[np.floating[Any]]
_Select = Callable[[_Column, Any], npt.NDArray[np.bool_]]

# as in the page, which has these for the limit 0.1
COMPARISONS: Final[dict[str, _Select]] = {
    "x > 0.1::FLOAT": np.greater,
    "x >= 0.1::FLOAT": np.greater_equal,
    "x < 0.1::FLOAT": np.less,
    "x <= 0.1::FLOAT": np.less_equal,
    "x = 0.1::FLOAT": np.equal,
    "x is distinct from 0.1::FLOAT": np.not_equal,
    "(x > 0.1::FLOAT) is not true": lambda x, limit: ~(x > limit),
}
TESTS: Final[dict[str, Callable[[_Column], npt.NDArray[np.bool_]]]] = {
    "x is null": np.isnan,
    "isinf(x)": np.isinf,
    "isfinite(x)": np.isfinite,
}


@pytest.fixture
def special(tmp_path: Path) -> Path:
    """Return a recording with NaN, infinities and the limits of float32 in vxy_max, and NaN in ref_lat, a float64."""
    fields = [
        {"timestamp": number, "vxy_max": value, "ref_lat": value if abs(value) <= 90 else math.nan}
        for number, value in enumerate(VALUES, 1)
    ]
    return write(tmp_path / "special.mcap", {VLP: array_of(VLP, *fields)})


@dataclass(frozen=True)
class Export:
    """A table in DuckDB: `name` for messages of a test, `table` in SQL."""

    name: str
    connection: Any
    table: str

    def timestamps(self, where: str, *parameters: float) -> list[int]:
        """Return the timestamps of the rows that a filter selects."""
        query = f"select timestamp from {self.table} where {where} order by timestamp"  # noqa: S608 - of this test
        return [timestamp for (timestamp,) in self.connection.execute(query, parameters).fetchall()]


def exports(path: Path, folder: Path) -> Iterator[Export]:
    """Yield the exports that the page recommends: files and data frames of pandas and of polars.

    The files of a few messages are also written with one row in each group.
    """
    duckdb: Any = pytest.importorskip("duckdb")
    for package in ("pyarrow", "pandas", "polars"):
        pytest.importorskip(package)
    in_pandas = nedbus.read(path, dataframe="pandas")
    in_polars = nedbus.read(path, dataframe="polars").fill_nan(None)
    in_pandas.to_parquet(folder / "pandas.parquet")
    in_polars.write_parquet(folder / "polars.parquet")
    with duckdb.connect() as connection:
        connection.register("in_pandas", in_pandas)
        connection.register("in_polars", in_polars)
        yield Export("pandas", connection, "in_pandas")
        yield Export("polars", connection, "in_polars")
        yield Export("pandas, Parquet", connection, f"'{folder / 'pandas.parquet'}'")
        yield Export("polars, Parquet", connection, f"'{folder / 'polars.parquet'}'")
        if len(in_pandas) <= len(VALUES):
            # each row has statistics of its own, by which DuckDB leaves it out
            in_pandas.to_parquet(folder / "pandas-rows.parquet", row_group_size=1)
            in_polars.write_parquet(folder / "polars-rows.parquet", row_group_size=1)
            yield Export("pandas, groups", connection, f"'{folder / 'pandas-rows.parquet'}'")
            yield Export("polars, groups", connection, f"'{folder / 'polars-rows.parquet'}'")


def different_filters(path: Path, folder: Path, columns: dict[str, tuple[float, ...]]) -> list[str]:
    """Return the filters of these columns, with their limits, whose rows differ between an export and NumPy."""
    array: MessageArray = nedbus.read(path)
    differences = list[str]()
    for export in exports(path, folder):
        for column, limits in columns.items():
            values = array[column]
            kind = TYPES[values.dtype.str[1:]]
            for where, is_selected in TESTS.items():
                expected = array["timestamp"][is_selected(values)].tolist()
                query = re.sub(r"\bx\b", column, where)
                if export.timestamps(query) != expected:
                    differences.append(f"{export.name}: {query}")
            for where, compare in COMPARISONS.items():
                query = re.sub(r"\bx\b", column, where)
                expected = array["timestamp"][compare(values, values.dtype.type(0.1))].tolist()
                if export.timestamps(query.replace("0.1::FLOAT", f"?::{kind}"), 0.1) != expected:
                    differences.append(f"{export.name}: {query}, as a parameter")
                for limit in limits:
                    text = repr(limit) if math.isfinite(limit) else f"'{limit!r}'"
                    with_limit = query.replace("0.1::FLOAT", f"{text}::{kind}")
                    expected = array["timestamp"][
                        compare(values, values.dtype.type(limit))
                    ].tolist()
                    if export.timestamps(with_limit) != expected:
                        differences.append(f"{export.name}: {with_limit}")
    return differences


@pytest.mark.slow
def test_duckdb_selects_the_rows_of_numpy(special: Path, tmp_path: Path) -> None:
    """Each filter of the page finds the rows that NumPy finds, with a limit that float32 rounds and an infinite one."""
    assert different_filters(special, tmp_path, {"vxy_max": (0.1, math.inf)}) == []
    array = nedbus.read(special)
    assert np.isnan(array["vxy_max"]).any()
    assert np.isinf(array["vxy_max"]).any()


@pytest.mark.long
def test_duckdb_selects_the_rows_of_numpy_for_all_limits(special: Path, tmp_path: Path) -> None:
    """The same holds for every limit of float32 and of float64."""
    assert different_filters(special, tmp_path, {"vxy_max": LIMITS, "ref_lat": LIMITS}) == []


@pytest.mark.long
@pytest.mark.logs
def test_duckdb_selects_the_rows_of_numpy_in_a_real_log(tmp_path: Path) -> None:
    """The same holds for a log of PX4 1.16, in which vxy_max is infinite; ref_lat is a float64."""
    array = nedbus.read(LOGS / "cuav_1.16_gps_interference.ulg")
    columns = dict[str, tuple[float, ...]]()
    for column in ("vxy_max", "eph", "ref_lat", "heading_var", "unaided_heading"):
        finite = array[column][np.isfinite(array[column])]
        columns[column] = (0.1, *map(float, finite[:: max(1, len(finite) // 4)]))
    assert np.isinf(array["vxy_max"]).any()
    assert different_filters(LOGS / "cuav_1.16_gps_interference.ulg", tmp_path, columns) == []


def test_page_has_the_filters_that_are_tested() -> None:
    """The table of filters in the page has those that are tested, and no other."""
    listed = re.findall(r"^\| `[^|]*` \| `([^`]+)` \|$", PAGE.read_text(), re.MULTILINE)
    assert listed == [*COMPARISONS, *TESTS]


@pytest.mark.slow
def test_duckdb_snippet_of_the_page_runs(special: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The snippets of the page run, and the file that they write has the messages of the flight."""
    duckdb: Any = pytest.importorskip("duckdb")
    pytest.importorskip("pyarrow")
    pytest.importorskip("pandas")
    monkeypatch.chdir(special.parent)
    special.rename("flight.mcap")
    for snippet in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(compile(snippet, str(PAGE), "exec"), {})  # noqa: S102 - our own docs
    assert duckdb.sql("select count(*) from 'flight.parquet'").fetchall() == [(len(VALUES),)]
