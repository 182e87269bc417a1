"""One body on a ball joint at the origin: J ω̇′ = s × m Aᵀg − ω′ × J ω′, s from the joint to the centre."""

import json
import sys

import numpy as np

HELLO = {"protocol": 1, "name": "toy", "title": "Toy in Python", "version": "0.1", "joints": ["ball"]}
HELLO |= {"quantities": ["joint_acceleration"], "gaps": {"chains": "the toy has one body"}}
model = {}


def turning(p, omega):
    m, g, s = model["mass"][0], np.array(model["gravity"]), -np.array(model["point"][0][1])
    w, v = p[0], np.array(p[1:])
    fall = g - 2 * w * np.cross(v, g) + 2 * np.cross(v, np.cross(v, g))  # Aᵀg
    J = model["inertia"][0] + m * (s @ s * np.eye(3) - np.outer(s, s))
    return np.linalg.solve(J, np.cross(s, m * fall) - np.cross(omega, J @ omega))


def answer(question):
    match question["ask"]:
        case "hello":
            return HELLO
        case "echo":
            return {"values": question["values"]}
        case "model":
            model.update(question["model"])
            return {}
        case "evaluate":
            moving = ((state["p"][0], state["omega"][0]) for state in question["states"])
            return {"answers": [{"joint_acceleration": turning(*one).tolist()} for one in moving]}


for line in sys.stdin:
    question = json.loads(line)
    print(json.dumps({"id": question["id"], **answer(question)}), flush=True)
