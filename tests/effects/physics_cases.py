"""Two scenes for each effect of physics: the place for what stands in `PHYSICS_EFFECTS`."""

from dataclasses import replace

from schemas.scene import ScenePlan
from tests.effects.cases import Case
from tests.effects.scenes import Setting


def on_a_bumpy_table(plan: ScenePlan) -> ScenePlan:
    """The same table, said to have no convex level top."""
    return replace(plan, table=replace(plan.table, top=replace(plan.table.top, convex=False)))


PHYSICS: dict[str, Case] = {
    "dynamics": Case(
        Setting({"start": {"pose": "upright"}}),
        Setting({"start": {"pose": "placed"}}),
        "placed in a statically stable pose",
    ),
    "table_mesh": Case(Setting({}, on_a_bumpy_table), Setting({}), "the table's top is level and convex"),
}
