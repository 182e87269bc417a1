"""The catalogue is complete, starts on the manifold, and its descriptions are true."""

import json
import math
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from plumbline.engines.adapter import check_state, check_times
from plumbline.model.kinematics import joint_vectors, rotation_matrix
from plumbline.scenario import loader as scenarios
from plumbline.scenario.schema import Attitude, Document, Inertia, attitude_quaternion, inertia_matrix
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios, states_of
from tests.helpers.refusals import refusal

EPS = np.finfo(float).eps

# What must be there: name, joints, closed form.
_TABLE = (Path(__file__).parent / "catalogue.txt").read_text(encoding="utf-8").splitlines()[1:]
CATALOGUE = {name: tuple(about) for name, *about in (line.split(" | ") for line in _TABLE)}


CHAINS = [
    name for name in CATALOGUE if catalogue_scenario(name).path.parent.name in ("single", "double", "chain")
]


def assert_close(got, expected, ulps=4):
    scale = max(1.0, float(np.max(np.abs(expected))))
    np.testing.assert_allclose(got, expected, rtol=0, atol=ulps * EPS * scale)


def counted(kinds):
    return " ".join(f"{len([*same])}×{kind}" for kind, same in groupby(kinds))


def test_the_catalogue_is_the_issues_list():
    named = {name: s for name, s in catalogue_scenarios().items() if not name.startswith("crowded-")}
    found = {name: (counted(s.model.kind), s.closed_form) for name, s in named.items()}
    assert list(found) == list(CATALOGUE)
    assert {name: tuple(filter(None, about)) for name, about in found.items()} == CATALOGUE


@pytest.mark.parametrize("name", CHAINS)
def test_scenario_starts_exactly_on_the_manifold(name):
    s = catalogue_scenario(name)
    check_state(s.model, s.state)
    check_times(s.times, s.sample_interval / 4)
    gap = np.linalg.norm(joint_vectors(s.model, s.state.r, s.state.p), axis=1) - s.model.length
    reach = np.cumsum(s.model.length + np.linalg.norm(s.model.proximal, axis=1))
    assert np.all(np.abs(gap) <= 8 * EPS * np.maximum(reach, 1))
    assert np.all(np.abs(np.linalg.norm(s.state.p, axis=1) - 1) <= 4 * EPS)
    assert np.all(np.abs(np.linalg.norm(s.state.u, axis=1) - s.model.rods) <= 4 * EPS)
    along = np.abs(np.sum(s.state.u * s.state.udot, axis=1))
    assert np.all(along <= 2 * EPS * np.maximum(np.linalg.norm(s.state.udot, axis=1), 1e-300))


@pytest.mark.parametrize("name", CHAINS)
def test_a_scenario_has_title_and_purpose(name):
    s = catalogue_scenario(name)
    assert (s.name, s.family, s.schema_version) == (name, s.path.parent.name, 1)
    assert s.path.name == f"{name}.yaml"
    assert s.purpose.endswith(".") and len(s.purpose) > 60
    assert s.times[0] == 0 and s.times[-1] == s.duration == 2.0
    # powers of two, so that every step 2^-k hits the samples; in one scenario no step is one
    assert (math.frexp(s.sample_interval)[0] == 0.5) == (name != "double-loaded-rods")
    assert len(s.body_names) == s.model.n


def test_generic_scenarios_have_nothing_special_in_them():
    """They carry the proof, so no inertia entry, offset or rate may be 0 and no two bodies alike."""
    for name in [
        "tumbling-ball",
        "tumbling-rod",
        "double-tumbling-balls",
        "double-tumbling-rods",
        "chain-3-balls",
    ]:
        m, s = catalogue_scenario(name).model, catalogue_scenario(name).state
        assert np.all(m.inertia != 0) and np.all(m.proximal != 0) and np.all(m.distal[:-1] != 0)
        assert np.all(s.omega != 0) and np.all(s.p != 0)
        assert np.all(s.udot[m.rods] != 0)
        assert len(np.unique(m.mass)) == m.n
    for name in ["chain-10-balls", "chain-30-balls", "chain-50-balls", "chain-10-rods", "chain-5-mixed"]:
        s = catalogue_scenario(name)
        assert np.linalg.matrix_rank(np.diff(s.state.r, axis=0)) == 3, "the chain lies in a plane"
        assert len(np.unique(s.state.p.round(9), axis=0)) == s.model.n
        assert np.all(s.model.inertia != 0) and np.all(s.model.proximal != 0)


@pytest.mark.parametrize(
    "name", ["planar-small", "planar-170", "planar-rotating", "double-planar-large", "double-planar-small"]
)
def test_planar_scenarios_move_in_one_plane(name):
    s = catalogue_scenario(name)
    normal = rotation_matrix(s.state.p)[:, :, 1]  # each body's y axis
    assert_close(normal, normal[:1] * np.ones_like(normal))
    assert abs(normal[0, 2]) < EPS and np.all(np.abs(normal[0, :2]) > 0.1)  # horizontal, no axis of the world
    assert_close(s.state.r @ normal[0], np.zeros(s.model.n))
    assert not np.any(s.state.omega[:, [0, 2]])
    assert not np.any(s.model.inertia[:, 1, [0, 2]]) and not np.any(s.model.proximal[:, 1])


def test_planar_rotating_is_above_the_separatrix():
    m, s = catalogue_scenario("planar-rotating").model, catalogue_scenario("planar-rotating").state
    inertia = m.inertia[0, 1, 1] + m.mass[0] * m.proximal[0] @ m.proximal[0]
    assert inertia * s.omega[0, 1] ** 2 / 2 > 2 * m.mass[0] * 9.81 * np.linalg.norm(m.proximal[0])


def test_free_top_flips_about_its_intermediate_axis_within_its_duration():
    """Euler's equations, one body at a time: the spin about y changes its sign before 2 s."""
    from scipy.integrate import solve_ivp

    s = catalogue_scenario("free-top")
    J = s.model.inertia[0]
    run = solve_ivp(
        lambda t, w: np.linalg.solve(J, -np.cross(w, J @ w)),
        (0, s.duration),
        s.state.omega[0],
        rtol=1e-10,
        atol=1e-10,
    )
    assert np.min(run.y[1]) < -0.9 * run.y[1, 0]


# --- the file format ---------------------------------------------------------------------------------

finite = st.floats(-100, 100, allow_subnormal=False)
unit_range = st.floats(-1, 1)
vectors = st.lists(finite, min_size=3, max_size=3)
directions = st.lists(unit_range, min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 1e-3)
CONVENTIONS = [
    f"{order} {axes}"
    for order in ("intrinsic", "extrinsic")
    for axes in ("xyx", "xyz", "xzx", "xzy", "yxy", "yxz", "yzx", "yzy", "zxy", "zxz", "zyx", "zyz")
]


def assert_same_attitude(p, other):
    return assert_close(rotation_matrix(np.asarray(p)), Rotation.from_matrix(other).as_matrix(), 16)


@given(directions, st.floats(-7, 7))
def test_axis_angle_is_scipys(axis, angle):
    p = attitude_quaternion(Attitude.model_validate({"axis_angle": {"axis": axis, "angle": angle}}))
    assert_same_attitude(p, Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix())


@given(st.sampled_from(CONVENTIONS), st.lists(st.floats(-400, 400), min_size=3, max_size=3))
def test_euler_angles_are_scipys(convention, degrees):
    p = attitude_quaternion(
        Attitude.model_validate({"euler": {"convention": convention, "degrees": degrees}})
    )
    order, axes = convention.split()
    axes = axes.upper() if order == "intrinsic" else axes
    with np.errstate(all="ignore"):
        assert_same_attitude(p, Rotation.from_euler(axes, degrees, degrees=True).as_matrix())


@given(
    st.lists(unit_range, min_size=4, max_size=4).filter(lambda v: np.linalg.norm(v) > 1e-3),
    st.floats(1e-200, 1e200),
)
def test_quaternions_of_any_length_are_normalised(q, scale):
    p = attitude_quaternion(Attitude.model_validate({"quaternion": [scale * x for x in q]}))
    assert abs(np.linalg.norm(p) - 1) <= 4 * EPS
    assert_close(p, np.array(q) / np.linalg.norm(q), 8)


@given(st.lists(st.floats(1e-3, 1), min_size=3, max_size=3), directions, st.floats(-7, 7))
def test_the_three_forms_of_an_inertia_are_one(moments, axis, angle):
    a, b, c = moments  # second moments of the mass: their pairwise sums obey the triangle inequality
    axes = {"axis_angle": {"axis": axis, "angle": angle}}
    J = inertia_matrix(Inertia.model_validate({"principal": [b + c, a + c, a + b], "axes": axes}))
    R = rotation_matrix(attitude_quaternion(Attitude.model_validate(axes)))
    assert_close(R.T @ J @ R, np.diag([b + c, a + c, a + b]), 16)
    six = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
    np.testing.assert_array_equal(inertia_matrix(Inertia.model_validate({"six": six})), J)
    np.testing.assert_array_equal(inertia_matrix(Inertia.model_validate({"matrix": J.tolist()})), J)


bodies = st.fixed_dictionaries(
    {
        "mass": st.floats(1e-3, 1e3),
        "inertia": st.sampled_from(
            [{"six": [0.2, 0.3, 0.35, 0.02, -0.03, 0.01]}, {"principal": [0.1, 0.2, 0.25]}]
        ),
        "joint": st.one_of(
            st.just({"kind": "ball"}),
            st.fixed_dictionaries(
                {
                    "kind": st.just("rod"),
                    "length": st.floats(1e-6, 10),
                    "direction": directions,
                    "angular_velocity": vectors,
                }
            ),
        ),
        "proximal": vectors,
        "distal": vectors,
        "attitude": st.fixed_dictionaries(
            {
                "quaternion": st.lists(unit_range, min_size=4, max_size=4).filter(
                    lambda v: np.linalg.norm(v) > 1e-3
                )
            }
        ),
        "angular_velocity": vectors,
        "load": st.fixed_dictionaries({"force": vectors, "moment": vectors}),
        "drag": st.fixed_dictionaries({"force": st.floats(0, 10), "moment": st.floats(0, 10)}),
    }
)


def as_yaml(document):
    """JSON is YAML 1.2, and Python writes its floats so that they parse to the same bits."""
    return json.dumps(document, ensure_ascii=False)


def scenario_document(chain, **more):
    return {"schema_version": 1, "title": "A chain", "purpose": "Random.", "bodies": chain, **more}


@settings(max_examples=40, deadline=None)
@given(st.lists(bodies, min_size=1, max_size=4), vectors)
def test_random_scenarios_come_back_bit_for_bit(chain, gravity):
    s = scenarios.load_scenario_text(as_yaml(scenario_document(chain, gravity=gravity)))
    m = s.model
    np.testing.assert_array_equal(m.mass, [b["mass"] for b in chain])
    np.testing.assert_array_equal(m.gravity, gravity)
    for field in ("proximal", "angular_velocity", "load.force", "load.moment", "drag.force", "drag.moment"):
        expected = [
            b[field] if "." not in field else b[field.split(".")[0]][field.split(".")[1]] for b in chain
        ]
        got = {
            "proximal": m.proximal,
            "angular_velocity": s.state.omega,
            "load.force": m.force,
            "load.moment": m.moment,
            "drag.force": m.drag_force,
            "drag.moment": m.drag_moment,
        }[field]
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(m.distal[:-1], [b["distal"] for b in chain[:-1]] or np.empty((0, 3)))
    assert not np.any(m.distal[-1])
    for k, body in enumerate(chain):
        if body["joint"]["kind"] == "rod":
            u = np.array(body["joint"]["direction"]) / np.linalg.norm(body["joint"]["direction"])
            assert_close(s.state.u[k], u)
            assert_close(s.state.udot[k], np.cross(body["joint"]["angular_velocity"], u), 8 * 100)
            assert abs(s.state.u[k] @ s.state.udot[k]) <= 2 * EPS * max(
                np.linalg.norm(s.state.udot[k]), 1e-300
            )
    again = scenarios.load_scenario_text(as_yaml(s.document))
    assert again.digest == s.digest
    for field in vars(s.state):
        np.testing.assert_array_equal(getattr(again.state, field), getattr(s.state, field))


@settings(max_examples=20, deadline=None)
@given(st.lists(bodies, min_size=1, max_size=3), st.integers(1, 7), directions, st.floats(-90, 90))
def test_a_run_is_its_bodies_written_out(cycle, repeat, axis, degrees):
    turn = {"axis": axis, "degrees": degrees}
    run = scenarios.load_scenario_text(
        as_yaml(scenario_document([{"repeat": repeat, "cycle": cycle, "turn": turn}]))
    )
    plain = scenarios.load_scenario_text(
        as_yaml(scenario_document([cycle[j % len(cycle)] for j in range(repeat)]))
    )
    for field in run.model.fields:
        np.testing.assert_array_equal(getattr(run.model, field), getattr(plain.model, field))
    np.testing.assert_array_equal(run.state.omega, plain.state.omega)
    for j in range(repeat):
        R = Rotation.from_rotvec(np.radians(j * degrees) * np.array(axis) / np.linalg.norm(axis)).as_matrix()
        assert_close(rotation_matrix(run.state.p[j]), R @ rotation_matrix(plain.state.p[j]), 32)
        assert_close(run.state.u[j], R @ plain.state.u[j], 32)
        assert_close(run.state.udot[j], R @ plain.state.udot[j], 32)


def test_a_rods_rate_may_be_typed_with_finite_digits():
    """A part of 1e-13 along the rod is rounding: accepted, and then taken out."""
    text = (scenarios.CATALOGUE_FOLDER / "single" / "spherical.yaml").read_text(encoding="utf-8")
    s = scenarios.load_scenario_text(text.replace("[0.4, 2.5, 0.3]", "[0.8, 0, 0.6000000000003]"))
    assert_close(s.state.udot[0], [0.8, 0, 0.6], 2000)
    assert abs(s.state.u[0] @ s.state.udot[0]) <= 2 * EPS


def test_a_run_turns_its_rods_rates_too():
    rod = {"kind": "rod", "length": 0.5, "direction": [0.6, 0, -0.8], "rate": [0.8, 1.5, 0.6]}
    body = {
        "mass": 1,
        "inertia": {"principal": [1, 1, 1]},
        "joint": rod,
        "proximal": [0, 0, 1],
        "distal": [0, 0, -1],
    }
    body["attitude"] = {"quaternion": [1, 0, 0, 0]}
    run = {"repeat": 3, "cycle": [body], "turn": {"axis": [0, 0, 1], "degrees": 90}}
    s = scenarios.load_scenario_text(as_yaml(scenario_document([run])))
    assert_close(s.state.u, [[0.6, 0, -0.8], [0, 0.6, -0.8], [-0.6, 0, -0.8]])
    assert_close(s.state.udot, [[0.8, 1.5, 0.6], [-1.5, 0.8, 0.6], [-0.8, -1.5, 0.6]])


def test_made_content_passes_the_checks_of_a_file():
    body = {
        "mass": 1.0,
        "inertia": {"principal": [0.1, 0.1, 0.1]},
        "proximal": [0.0, 0.0, 0.3],
        "attitude": {"quaternion": [1.0, 0.0, 0.0, 0.0]},
        "joint": {"kind": "ball"},
    }
    chain = [{**body, "distal": [0.0, 0.0, -0.3]}, body]
    made, written = (
        scenarios.scenario_from_dict(scenario_document(chain), "x.yaml"),
        scenarios.load_scenario_text(as_yaml(scenario_document(chain)), "x.yaml"),
    )
    assert (made.digest, made.name) == (written.digest, written.name)
    light = scenario_document([{**body, "mass": -1.0}, body])
    assert [(p.file, p.field) for p in refusal(scenarios.scenario_from_dict, light, "x.yaml").problems] == [
        ("x.yaml", "bodies[0].distal"), ("x.yaml", "bodies[0].mass"),
    ]  # fmt: skip


def test_the_digest_is_of_the_content():
    text = (scenarios.CATALOGUE_FOLDER / "single" / "tumbling-rod.yaml").read_text(encoding="utf-8")
    base = scenarios.load_scenario_text(text).digest
    assert scenarios.load_scenario_text("# a comment\n" + text.replace("1.3", "1.30")).digest == base
    assert scenarios.load_scenario_text(as_yaml(YAML(typ="safe").load(text))).digest == base
    for old, new in (("1.3", "1.3000000000000003"), ("tumbling", "rolling"), ("length: 0.4", "length: 0.5")):
        assert scenarios.load_scenario_text(text.replace(old, new)).digest != base


def test_a_seed_keeps_the_states_where_only_a_text_changes():
    first = catalogue_scenario("nesc-tumbling-brick")
    changed = first.document | {"purpose": "Another text."}
    other, kept = (
        scenarios.scenario_from_dict(document, "copy.yaml")
        for document in (changed, changed | {"seed": first.digest})
    )
    assert len({first.digest, other.digest, kept.digest}) == 3
    states = [states_of(s, 2)[1].p for s in (first, other, kept)]
    assert np.array_equal(states[0], states[2]) and not np.any(states[0] == states[1])


def test_names_may_be_any_text_that_can_name_a_file():
    text = (scenarios.CATALOGUE_FOLDER / "single" / "rest.yaml").read_text(encoding="utf-8")
    for name in (
        "<img onerror=alert(1)>",
        "$(x)",
        "ä ö",
        "日本",
        "-x",
        "con",
        "Rest",
        "a..b",
        "v1.2",
        "a" * 80,
    ):
        assert scenarios.load_scenario_text(text + f"name: {json.dumps(name)}\n").name == name


BAD_NAMES = {  # and what the message says of it
    "../../evil": "has the character /", "/abs/x": "has the character /", "a/b": "has the character /",
    "..\\x": "has the character \\", "a\\b": "has the character \\", ".": "starts with a dot",
    "..": "starts with a dot", ".hidden": "starts with a dot", " a": "has blanks at its ends",
    "a\nb": "has the character U+000A", "a\tb": "has the character U+0009",
    "a\x1b[1m": "has the character U+001B",
    "a\x7f": "has the character U+007F", "a\u202eb": "has the character U+202E",
    "\u2028": "has the character U+2028", "a ": "has blanks at its ends", "日" * 70: "has 210 bytes",
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_NAMES)
def test_a_name_that_cannot_name_a_file_is_refused(tmp_path, name):
    text = (scenarios.CATALOGUE_FOLDER / "single" / "rest.yaml").read_text(encoding="utf-8")
    lines = text.count("\n") + 1
    text += f"name: {json.dumps(name)}\n"
    (problem,) = refusal(scenarios.load_scenario_text, text, "x.yaml").problems
    assert str(problem).startswith(
        f"x.yaml:{lines}:7: name: {BAD_NAMES[name]}; valid would be a name for files"
    )


@pytest.mark.parametrize("stem", ["a\\b", ".hidden", "a\nb", " a"])
def test_a_files_name_that_cannot_be_the_scenarios_is_refused(tmp_path, stem):
    path = tmp_path / f"{stem}.yaml"
    path.write_bytes((scenarios.CATALOGUE_FOLDER / "single" / "rest.yaml").read_bytes())
    (problem,) = refusal(scenarios.load_scenario, path).problems
    assert (problem.line, problem.column, problem.field) == (1, 1, "name")
    assert problem.message.startswith("is the file's name, which ") and "`name:`" in problem.hint
    path.write_bytes(path.read_bytes() + b"\nname: good\n")
    assert scenarios.load_scenario(path).name == "good"


def test_load_many_takes_names_and_paths_and_keeps_their_order():
    names = ["rest", scenarios.find_scenario_file("conical"), "double-conical", "rest"]
    assert [s.name for s in scenarios.load_scenarios(names)] == ["rest", "conical", "double-conical"]


def test_the_catalogue_is_found_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert scenarios.find_scenario_file("rest").is_file()
    assert scenarios.find_scenario_file("mine.yaml").name == "mine.yaml"


def test_the_schema_describes_every_field():
    schema = scenarios.json_schema()
    assert schema["$schema"].endswith("2020-12/schema")
    parts = [schema, *schema["$defs"].values()]
    assert {part["title"] for part in parts} >= {
        "Document",
        "Body",
        "BodySequence",
        "Rod",
        "Ball",
        "Inertia",
        "Attitude",
    }
    for part in parts:
        assert part["additionalProperties"] is False
        for name, field in part["properties"].items():
            assert field.get("description"), f"{part['title']}.{name} has no description"
    assert set(schema["required"]) == {"schema_version", "title", "purpose", "bodies"}
    assert set(schema["properties"]) == set(Document.model_fields)
