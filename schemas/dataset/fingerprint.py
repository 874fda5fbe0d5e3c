"""What a stack is, told by what it makes."""

import hashlib

from schemas.base import Frozen


class Fingerprint(Frozen):
    """A stack of software and hardware: two with the same digest make the same bytes.

    `canary` is the SHA-256 of a small scene, made from plan to encoded files; `code` that of the project's own source;
    `libraries` are the versions of what makes bytes; `simd` is the widest instruction set numpy may use; `renderer`
    is what GL calls itself.
    """

    canary: str
    code: str
    libraries: dict[str, str]
    simd: str
    renderer: str

    @property
    def digest(self) -> str:
        """SHA-256, hex, of all of it."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def differences(self, other: "Fingerprint") -> list[str]:
        """One line for each thing that differs, `name: mine, theirs`."""
        mine, theirs = self.model_dump(), other.model_dump()
        lines = [
            f"{key}: {mine[key]}, {theirs[key]}" for key in mine if key != "libraries" and mine[key] != theirs[key]
        ]
        names = sorted(set(self.libraries) | set(other.libraries))
        pairs = [(name, self.libraries.get(name, "absent"), other.libraries.get(name, "absent")) for name in names]
        return lines + [f"{name}: {a}, {b}" for name, a, b in pairs if a != b]
