"""A program that answers protocol 1 with zeros of the right shapes, but for the lie its argument names."""

import json
import os
import signal
import subprocess
import sys

LIE = sys.argv[1] if len(sys.argv) > 1 else ""
HELLO = {
    "protocol": 1, "name": "liar", "title": "Liar", "version": "1",
    "joints": ["rod", "ball", "hinge", "slide", "universal", "cylindrical", "weld", "free"],
    "quantities": ["acceleration", "angular_acceleration", "kinetic_energy"],
    "has": ["trees", "loads"],
    "integrators": [{"name": "still", "kind": "step", "order": 1, "error_exponents": [1, 2]}],
}  # fmt: skip
HELLOS = {
    "another protocol": {"protocol": 2},
    "no protocol": {"protocol": None},
    "unknown joint": {"joints": ["ball", "elbow"]},
    "unknown quantity": {"quantities": ["acceleration", "colour"]},
    "single precision": {"precision": "single"},
    "order zero": {"integrators": [{"name": "still", "kind": "step", "order": 0}]},
    "order three": {"integrators": [{"name": "still", "kind": "step", "order": 3}]},
    "an integrator twice": {"integrators": HELLO["integrators"] * 2},
    "endless name": {"title": "x" * 300},
    "unknown field": {"colour": "red"},
    "accelerations twice": {"quantities": [*HELLO["quantities"], "joint_acceleration"]},
}
ANSWERS = {
    "not a number": {"kinetic_energy": float("nan")},
    "text for a number": {"kinetic_energy": "1.0"},
    "numbers in texts": {"acceleration": [["0", "0", "0"]]},
    "ragged rows": {"acceleration": [[0.0, 0.0, 0.0], [0.0]]},
    "another shape": {"acceleration": [0.0, 0.0, 0.0]},
    "a missing quantity": {"acceleration": None},
    "an undeclared quantity": {"potential_energy": 0.0},
    "an unknown quantity": {"colour": 1.0},
    "accelerations twice": {"joint_acceleration": [0.0] * 6},
}
model = {}


def zeros(*sizes):
    return [zeros(*sizes[1:]) for _ in range(sizes[0])] if sizes else 0.0


def evaluate(question):
    n, count = len(model["mass"]), len(question["states"])
    honest = {"acceleration": zeros(n, 3), "angular_acceleration": zeros(n, 3), "kinetic_energy": 0.0}
    found = [{**honest, **ANSWERS.get(LIE, {})} for _ in range(count)]
    match LIE:
        case "too few answers":
            return {"answers": found[1:]}
        case "no list":
            return {"answers": {"0": found[0]}}
        case "no record":
            return {"answers": [1.0] * count}
        case "an error":
            return {"error": "the factorisation failed"}
        case "an undeclared refusal":
            return {"unsupported": "not today", "gap": "loads"}
        case "a refusal for a quantity":
            return {"unsupported": "not today", "gap": "mass_matrix"}
        case "a refusal for a joint that it builds":
            return {"unsupported": "not today", "gap": "joints"}
    return {"answers": found}


def simulate(question):
    t, n = question["times"], len(model["mass"])
    state, size = question["state"], len(question["times"])
    moved = [[[x + at for x in body] for body in state["r"]] for at in t]
    run = {
        "t": t,
        "r": moved,
        "p": [state["p"]] * size,
        "v": [zeros(n, 3)] * size,
        "omega": [zeros(n, 3)] * size,
    }
    run["steps"] = round(t[-1] / question["resolution"])
    match LIE:
        case "other steps":
            run["steps"] += 1
        case "other times":
            run["t"] = t[:-1]
        case "other shapes":
            run["omega"] = zeros(size, n, 4)
        case "no steps":
            del run["steps"]
    return run


def misbehave(question):
    """What is no answer at all."""
    match LIE:
        case "exit":
            print("cannot allocate", file=sys.stderr, flush=True)
            os._exit(7)
        case "signal":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "half a line":
            print('{"id": ', end="", flush=True)
            os._exit(0)
        case "words":
            print("Loading …", flush=True)
        case "late":
            question["id"] -= 1
        case "twice":
            print(json.dumps({"id": question["id"], **evaluate(question)}), flush=True)
        case "no record at all":
            print("[1, 2]", flush=True)
        case "deep":
            print("[" * 100_000, flush=True)
        case "not UTF-8":
            sys.stdout.buffer.write(b"\xff\xfe\n")
            sys.stdout.flush()
        case "huge":
            for _ in range(2**7):
                sys.stdout.write("9" * 2**20)
        case "infinity":
            print(f'{{"id": {question["id"]}, "answers": [{{"kinetic_energy": 1e999}}]}}', flush=True)
        case "closed output":
            os.close(1)
            signal.pause()
        case "grandchild":
            ignore = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
            subprocess.Popen([sys.executable, "-c", ignore], start_new_session=True)
            signal.pause()
        case "memory":
            kept = []
            while True:
                kept.append(bytearray(b"x" * 2**26))
        case "chatter":
            sys.stderr.write("x" * 2**24)
        case "another model":
            model["mass"] = model["mass"][1:]


def answer(question):
    match question["ask"]:
        case "hello" if LIE == "other at every start":
            return {**HELLO, "version": str(os.getpid())}
        case "hello":
            return {**HELLO, **HELLOS.get(LIE, {})}
        case "echo":
            lost = 1 if LIE == "echo too short" else 0
            values = question["values"][lost:]
            return {"values": [x * (1 + 2**-52) if LIE == "rounded" and x < 1 else x for x in values]}
        case "model":
            model.update(question["model"])
            is_refused = LIE == "refusal of one body" and len(model["mass"]) == 1
            return {"unsupported": "not one body"} if is_refused else {}
        case "simulate":
            return simulate(question)
    misbehave(question)
    return evaluate(question)


for line in sys.stdin:
    asked = json.loads(line)
    found = answer(asked)
    print(json.dumps({"id": asked["id"], **found}), flush=True)
