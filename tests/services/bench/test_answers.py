"""The inner end of a side process: one line back for each line, whatever libraries print."""

import json
import subprocess
import sys
from pathlib import Path

SIDE = """
from services.bench.answers import answer_scenes
def make(loaded, asked):
    print("noise")
    return {"stage": float(loaded["number"] + asked["more"])}
answer_scenes(lambda scene, folder, asked: scene, make)
"""


def test_every_line_gets_its_answer_and_noise_goes_elsewhere(tmp_path):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"number": 4}))
    asked = "".join(json.dumps({"scene": str(scene), "more": more}) + "\n" for more in (1, 2))
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(
        [sys.executable, "-c", SIDE], cwd=root, input=asked, capture_output=True, text=True, timeout=60, check=True
    )
    ready, *answers = map(json.loads, done.stdout.splitlines())
    assert ready == {"ready": True}
    assert [answer["stages_s"] for answer in answers] == [{"stage": 5.0}, {"stage": 6.0}]
    assert all(answer["wall_s"] >= 0 and answer["load_s"] >= 0 for answer in answers)
    assert done.stderr.count("noise") == 2
