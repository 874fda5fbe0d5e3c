"""The fingerprint of a stack of software and hardware: versions, and the bytes that it makes."""

import hashlib

from schemas.base import Frozen


class Fingerprint(Frozen):
    """A stack; two with the same digest make the same bytes.

    `canary` is the SHA-256 of a small scene, made from plan to encoded files; `code` that of the project's source;
    `libraries` holds the versions of libraries that make bytes; `simd` is the widest instruction set that numpy may use;
    `renderer` is GL's name of itself.
    """

    canary: str
    code: str
    libraries: dict[str, str]
    simd: str
    renderer: str

    @property
    def digest(self) -> str:
        """SHA-256, hex, of all fields."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def differences(self, other: "Fingerprint") -> list[str]:
        """One line for each difference, `name: mine, theirs`."""
        mine, theirs = self.model_dump(), other.model_dump()
        a, b = mine.pop("libraries"), theirs.pop("libraries")
        pairs = [(key, mine[key], theirs[key]) for key in mine]
        pairs += [(name, a.get(name, "absent"), b.get(name, "absent")) for name in sorted({*a, *b})]
        return [f"{name}: {ours}, {other}" for name, ours, other in pairs if ours != other]
