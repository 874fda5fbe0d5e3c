"""Two scenes for each effect of physics: the place for what stands in `PHYSICS_EFFECTS`."""

from dataclasses import replace

from schemas.scene.scene import Ground, ScenePlan
from tests.effects.cases import Case
from tests.effects.scenes import Setting


def on_a_bumpy_table(plan: ScenePlan) -> ScenePlan:
    """The same table, said to have no convex level top."""
    table = replace(plan.table, top=replace(plan.table.top, convex=False))
    return replace(plan, ground=Ground(table, plan.floor))


PLACED = Setting({"start": {"pose": "placed"}})
AT_REST = "placed in a statically stable pose"

PHYSICS: dict[str, Case] = {
    "dynamics": Case(Setting({"start": {"pose": "upright"}}), PLACED, AT_REST),
    "table_mesh": Case(
        Setting({}, on_a_bumpy_table), Setting({}), "all starts over the table's convex flat top, and nothing left it"
    ),
    "object_contacts": Case(
        Setting({"objects_per_scene": 3, "start": {"arrange": "pile"}}), Setting({}), "there is one object"
    ),
    "decomposition": Case(
        Setting({"categories": ["mug"]}, on_a_bumpy_table),
        Setting({"categories": ["mug"]}),
        "over a flat top an object touches with its hull alone",
    ),
    "fine_step": Case(Setting({}), PLACED, AT_REST),
    "rolling_friction": Case(Setting({}), Setting({"categories": ["laptop"]}), "nothing here is round"),
}
