"""Random robots as URDF and MJCF text, small and with everything that the formats allow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plumbline.model.datatypes import Array


def numbers(values: Sequence[float] | Array) -> str:
    """Values as an attribute."""
    return " ".join(repr(round(float(v), 6)) for v in np.ravel(values))


def inertia_entries(rng: np.random.Generator, mass: float) -> Array:
    """Ixx, ixy, ixz, iyy, iyz, izz of an ellipsoid of any attitude."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    size = rng.uniform(0.02, 0.2, 3) ** 2
    inertia = axes @ np.diag(mass / 5 * (size.sum() - size)) @ axes.T
    return np.asarray(inertia[np.triu_indices(3)])


def random_urdf(rng: np.random.Generator, n: int, kinds: Sequence[str] = ()) -> str:
    """A URDF with n moving links, some fixed ones between, and a tree of any shape."""
    kinds = kinds or ("revolute", "continuous", "prismatic", "revolute", "fixed")
    lines = ['<robot name="random">', _link(rng, "base")]
    names = ["base"]
    moving = 0
    while moving < n:
        kind = kinds[rng.integers(len(kinds))]
        name, parent = f"link{len(names)}", names[rng.integers(max(0, len(names) - 3), len(names))]
        lines.append(_link(rng, name))
        axis = "" if kind == "fixed" else f'<axis xyz="{numbers(rng.normal(size=3))}"/>'
        limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>' if kind != "fixed" else ""
        damping = rng.uniform(0.1, 1.0) if rng.random() < 0.5 else 0.0
        dynamics = f'<dynamics damping="{damping:.3f}"/>' if kind != "fixed" and damping else ""
        lines += [
            f'<joint name="joint{len(names)}" type="{kind}">',
            f'<origin xyz="{numbers(rng.normal(size=3) * 0.2)}" rpy="{numbers(rng.normal(size=3))}"/>',
            f'<parent link="{parent}"/><child link="{name}"/>{axis}{limit}{dynamics}',
            "</joint>",
        ]
        names.append(name)
        moving += kind != "fixed"
    return "\n".join([*lines, "</robot>"]) + "\n"


def _link(rng: np.random.Generator, name: str) -> str:
    mass = round(float(rng.uniform(0.3, 3)), 4)
    ixx, ixy, ixz, iyy, iyz, izz = (f"{x:.8f}" for x in inertia_entries(rng, mass))
    return (
        f'<link name="{name}"><inertial>\n'
        f'<origin xyz="{numbers(rng.normal(size=3) * 0.1)}" rpy="{numbers(rng.normal(size=3))}"/>\n'
        f'<mass value="{mass}"/>\n'
        f'<inertia ixx="{ixx}" ixy="{ixy}" ixz="{ixz}" iyy="{iyy}" iyz="{iyz}" izz="{izz}"/>\n'
        "</inertial></link>"
    )


def random_mjcf(rng: np.random.Generator, n: int) -> str:
    """An MJCF with n bodies: every kind of joint, several per body, references, springs and armature."""
    children: dict[int, list[int]] = {}
    for k in range(1, n):
        children.setdefault(int(rng.integers(max(0, k - 3), k)), []).append(k)

    def body(k: int) -> list[str]:
        place, turn = numbers(rng.normal(size=3) * 0.2), numbers(rng.normal(size=4))
        head = f'<body name="b{k}" pos="{place}" quat="{turn}">'
        mass = round(float(rng.uniform(0.3, 3)), 4)
        ixx, ixy, ixz, iyy, iyz, izz = inertia_entries(rng, mass)
        full = " ".join(f"{x:.8f}" for x in (ixx, iyy, izz, ixy, ixz, iyz))
        center = numbers(rng.normal(size=3) * 0.1)
        lines = [head, f'<inertial pos="{center}" mass="{mass}" fullinertia="{full}"/>']
        if k == 0 and rng.random() < 0.4:
            lines.append(f'<joint name="j{k}" type="free" damping="{rng.uniform(0, 1):.3f}"/>')
        else:
            for i in range(int(rng.integers(0 if k else 1, 4))):
                lines.append(joint(f"j{k}.{i}", ("hinge", "slide")[int(rng.integers(2))]))
            if rng.random() < 0.2:
                lines.append(joint(f"j{k}.ball", "ball"))
        for child in children.get(k, []):
            lines += body(child)
        return [*lines, "</body>"]

    def joint(name: str, kind: str) -> str:
        extra = {
            "damping": rng.uniform(0, 1), "stiffness": rng.uniform(0, 5), "armature": rng.uniform(0, 0.3),
        }  # fmt: skip
        if kind != "ball":
            extra |= {"ref": rng.normal(), "springref": rng.normal()}
        chosen = " ".join(f'{k}="{v:.4f}"' for k, v in extra.items() if rng.random() < 0.5)
        where = "" if kind == "slide" else f' pos="{numbers(rng.normal(size=3) * 0.1)}"'
        axis = "" if kind == "ball" else f' axis="{numbers(rng.normal(size=3))}"'
        return f'<joint name="{name}" type="{kind}"{axis}{where} {chosen}/>'

    lines = ['<mujoco model="random"><compiler angle="radian"/>', '<option gravity="0.3 -0.2 -9.7"/>']
    return "\n".join([*lines, "<worldbody>", *body(0), "</worldbody></mujoco>"]) + "\n"
