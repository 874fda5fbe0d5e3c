"""What an audit prints."""

from collections.abc import Iterator

from services.read.audit import Audit


def describe_audit(found: Audit) -> Iterator[str]:
    """Every fault, the figures, and what was proven of each effect, line by line."""
    yield from found.faults
    against = (
        "what is stored" if found.same_stack else "a plain scene made here, because another stack made what is stored"
    )
    yield (
        f"audit of {found.scenes} scenes: {found.forced} no-ops forced, {found.files} files "
        f"({found.bytes / 1e6:.1f} MB) compared to the byte with {against}"
    )
    motion = found.motion
    yield (
        f"  {found.released} released for 1 s with every effect: moved at most {motion.moved_mm:.4f} mm, turned at most "
        f"{motion.turned_deg:.5f} degrees; {motion.pixels_changed} mask pixels changed, {motion.pixels_outside} of them "
        "away from any silhouette"
    )
    for name, tally in found.effects.items():
        if tally.skipped:
            yield f"  {name} ({tally.kind}): left out in {tally.skipped} scenes, proven in {tally.proven}"
    yield f"  {len(found.faults) or 'nothing'} off"
