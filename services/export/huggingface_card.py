"""What Hugging Face wants beside the columns: the features in the metadata of a Parquet schema, and the dataset card."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

_CC0 = "CC0-1.0"


def features_metadata(schema: pa.Schema, image: pa.DataType) -> dict[bytes, bytes]:
    """Schema metadata that tells `datasets` which columns are images."""
    features = {field.name: _feature(field.type, image) for field in schema}
    return {b"huggingface": json.dumps({"info": {"features": features}}).encode()}


def _feature(kind: pa.DataType, image: pa.DataType) -> dict[str, Any]:
    if kind == image:
        return {"_type": "Image"}
    if pa.types.is_struct(kind):
        return {field.name: _feature(field.type, image) for field in kind}
    if pa.types.is_fixed_size_list(kind):
        return {"feature": _feature(kind.value_type, image), "length": kind.list_size, "_type": "List"}
    if pa.types.is_list(kind):
        return {"feature": _feature(kind.value_type, image), "_type": "List"}
    names = {pa.int64(): "int64", pa.float64(): "float64", pa.string(): "string", pa.bool_(): "bool"}
    return {"dtype": names[kind], "_type": "Value"}


def card_text(name: str, schema: pa.Schema, rows: Mapping[str, int], licences: Sequence[str]) -> str:
    """README.md: the head that Hugging Face reads, and what a person wants to know."""
    files = "".join(f"\n  - split: {split}\n    path: data/{split}-*.parquet" for split in sorted(rows)) or " []"
    counts = "".join(f"- {split}: {count} pairs\n" for split, count in sorted(rows.items()))
    columns = "".join(f"- `{field.name}`: {_describe(field)}\n" for field in schema)
    return f"""---
license: {"cc0-1.0" if set(licences) <= {_CC0} else "other"}
pretty_name: {json.dumps(name)}
task_categories:
- depth-estimation
- image-to-3d
configs:
- config_name: default
  data_files:{files}
---

# {name}

View-dependent RGB-D pairs for reconstructing objects from a single view: an input view of an object on a table, and the mirror
view from the other side. Made by Verso after Staszak and Belter, "Dataset for object reconstruction from a single view", Data in
Brief 55, 2024 (CC BY). A row is a pair. Splits are by object: no object of `test` or `validation` is seen in `train`.

{counts}
Licences of the shapes: {", ".join(licences) or "none"}.

```python
import datasets

pairs = datasets.load_dataset("path/to/this/folder", split="train")
```

## Columns

{columns}
## Conventions

- Depth is a 16-bit PNG: z along the optical axis. Divide by `depth_units_per_m` of the view for metres; 0 is no depth.
- Regions: 0 nothing, 1 floor, 2 table, 3 and up objects.
- Poses are row-major 4 x 4 matrices in metres: `T_world_cam` takes camera to world coordinates, `T_cam_obj` object to camera
  coordinates. Camera frames are optical: x right, y down, z forward. The world's z is up.
- `cx`, `cy` have pixel centres at +0.5; `cx_opencv`, `cy_opencv` have them on integers, as OpenCV does.
"""


def _describe(field: pa.Field) -> str:
    if pa.types.is_struct(field.type) and field.type.num_fields == 2 and field.type.field(0).name == "bytes":
        return "image"
    if pa.types.is_list(field.type):
        return "list of " + ", ".join(f"`{one.name}`" for one in field.type.value_type)
    if pa.types.is_struct(field.type):
        return "struct of " + ", ".join(f"`{one.name}`" for one in field.type)
    return "matrix" if pa.types.is_fixed_size_list(field.type) else str(field.type)
