"""Pairs of a range as one Arrow table, so that one expression chooses among scenes, views and assets. Pure."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.errors import InputError
from schemas.scene.view import ROLES

PAIR_TABLES = ("scenes", "views", "assets")
"""The tables that a choice of pairs reads."""


def pair_table(rows: Mapping[str, pa.Table]) -> pa.Table:
    """One row for each pair, by the pose id of its input view (`parent_id`).

    Columns: those of `scenes`, `parent_id`, one struct for each role with the columns of `views` (null where there is no
    such view), and the struct `asset` with the columns of `assets` of the scene's (first) object.
    """
    views = rows["views"]
    by_role = {role: views.filter(pc.field("role") == role) for role in ROLES}
    parents = np.unique(views.column("parent_id").to_numpy())
    scene_of = _take(views, "parent_id", parents).column("scene_id")
    scenes = _take(rows["scenes"], "scene_id", scene_of)
    table = scenes.append_column("parent_id", pa.array(parents, pa.int64()))
    for role, own in by_role.items():
        table = table.append_column(role, _structs(own, "parent_id", parents))
    return table.append_column("asset", _structs(rows["assets"], "instance_id", table.column("instance_id")))


def choose_pairs(table: pa.Table, where: pc.Expression | None) -> pa.Table:
    """The pairs for which `where` is true. Raises InputError naming what there is, where it names a column that is not."""
    if where is None:
        return table
    try:
        return table.filter(where)
    except (pa.ArrowException, NotImplementedError) as error:
        told = str(error).splitlines()[0]
        raise InputError(
            f"the filter cannot be used: {told[:200]}. Columns of a pair: {', '.join(table.column_names)}; those of a view "
            'or of the asset as pc.field("input", "visible_fraction") or pc.field("asset", "split")'
        ) from error


def _take(table: pa.Table, key: str, values: pa.ChunkedArray | np.ndarray) -> pa.Table:
    """The first row with each of the values, which is there."""
    return table.take(pc.index_in(pa.chunked_array([values]) if isinstance(values, np.ndarray) else values, table[key]))


def _structs(table: pa.Table, key: str, values: pa.ChunkedArray | np.ndarray) -> pa.ChunkedArray:
    """A struct of the first row with each of the values, null where there is none."""
    wanted = pa.chunked_array([pa.array(values)]) if isinstance(values, np.ndarray) else values
    return table.to_struct_array().take(pc.index_in(wanted, table[key]))
