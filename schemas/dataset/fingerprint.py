"""The fingerprint of a stack of software and hardware: versions, and the bytes that it makes."""

import hashlib

from schemas.base import Frozen


class Fingerprint(Frozen):
    """A stack; two with the same digest make the same bytes.

    `canary` is the SHA-256 of a small scene, made from plan to encoded files; `code` that of the project's source;
    `libraries` holds the versions of libraries that make bytes; `simd` is the widest instruction set that numpy may use;
    `renderer` is GL's name of itself; `maths` is the SHA-256 of what the C library's and numpy's functions give for many
    numbers, of which the canary scene may meet none that shows a difference.
    """

    canary: str
    code: str
    libraries: dict[str, str]
    simd: str
    renderer: str
    maths: str = ""

    @property
    def digest(self) -> str:
        """SHA-256, hex, of all fields."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def remedies(self, other: "Fingerprint") -> str:
        """What makes the two the same, by what differs: a clause without a full stop."""
        if self.code != other.code or self.libraries != other.libraries:
            return "install the same wheel and requirements.lock, or the same image, on both"
        if self.renderer != other.renderer:
            return "install the same Mesa (libgl1-mesa-dri), or the same GPU and driver, on both"
        if self.simd != other.simd:
            return (
                "use processors of one kind, and set NPY_DISABLE_CPU_FEATURES alike (deploy/Dockerfile has the value)"
            )
        if self.maths != other.maths:
            return "use machines of one kind with the same C library, or the same image, and unset GLIBC_TUNABLES"
        return "their processors or C libraries differ: use machines of one kind, or the same image"

    def differences(self, other: "Fingerprint") -> list[str]:
        """One line for each difference, `name: mine, theirs`."""
        mine, theirs = self.model_dump(), other.model_dump()
        a, b = mine.pop("libraries"), theirs.pop("libraries")
        pairs = [(key, mine[key], theirs[key]) for key in mine]
        pairs += [(name, a.get(name, "absent"), b.get(name, "absent")) for name in sorted({*a, *b})]
        return [f"{name}: {ours}, {other}" for name, ours, other in pairs if ours != other]
