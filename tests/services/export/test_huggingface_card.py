import json

import pyarrow as pa
import pytest
import yaml

from services.export.huggingface import card_text, features_metadata

IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
SCHEMA = pa.schema(
    [
        ("rgb", IMAGE),
        ("T", pa.list_(pa.float64(), 16)),
        ("objects", pa.list_(pa.struct([("u", pa.int64()), ("name", pa.string())]))),
        ("ok", pa.bool_()),
    ]
)


def test_the_datasets_package_makes_the_same_columns_of_the_features():
    datasets = pytest.importorskip("datasets")
    told = json.loads(features_metadata(SCHEMA, IMAGE)[b"huggingface"])["info"]["features"]
    assert datasets.Features.from_dict(told).arrow_schema.remove_metadata().equals(SCHEMA)


def test_a_licence_other_than_cc0_is_told():
    for licences, told in ((["CC0-1.0"], "cc0-1.0"), (["CC0-1.0", "ShapeNet"], "other")):
        text = card_text("a: b", SCHEMA, {"train": 3}, licences)
        head = yaml.safe_load(text.split("---\n")[1])
        assert (head["license"], head["pretty_name"]) == (told, "a: b")
        assert ", ".join(licences) in text


def test_an_export_without_a_pair_has_a_card_too():
    assert yaml.safe_load(card_text("x", SCHEMA, {}, []).split("---\n")[1])["configs"][0]["data_files"] == []
