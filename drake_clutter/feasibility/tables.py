"""Tables of a study, as CSV and Parquet."""

import csv
import importlib.util
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drake_clutter.files import atomic_write, write_text


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Any]) -> None:
    """Write a table as CSV and, with the extra `data`, as Parquet beside it.

    Args:
        path: Path of the tables without suffix.
        rows: Values by column; None and NaN are missing values.
        columns: The columns, in their order, with their types.
    """
    table = [{column: _missing_to_none(row[column]) for column in columns} for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    write_text(path.with_suffix(".csv"), text.getvalue())
    if importlib.util.find_spec("pyarrow"):
        # Imported late, because the extra is optional.
        import pyarrow as pa
        from pyarrow import parquet

        types = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
        schema = pa.schema([(name, types[kind]) for name, kind in columns.items()])
        with atomic_write(path.with_suffix(".parquet")) as temporary:
            parquet.write_table(pa.Table.from_pylist(table, schema), temporary)


def _missing_to_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
