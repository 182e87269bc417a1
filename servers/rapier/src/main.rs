//! Rapier's multibodies as a server of protocol 1: accelerations of trees with loads.
//!
//! A body's frame is at its centre of mass. A free body hangs from the world by a joint that locks nothing. A
//! ball's joint frames have the axes of its bodies, so its rates are those of ω − ω_far in the far body's axes.
//! Rapier tells accelerations after a step: one of 1e-16 s, in which nothing moves.

use rapier3d_f64::parry::mass_properties::MassProperties;
use rapier3d_f64::prelude::*;
use serde_json::{json, Value};
use std::io::{stdin, stdout, BufRead, Write};

const STEP: f64 = 1e-16;

fn hello() -> Value {
    let manifest = include_str!("../Cargo.toml");
    let after = manifest.split("rapier3d-f64 = \"=").nth(1).unwrap_or("?\"");
    json!({
        "protocol": 1, "name": "rapier", "title": "Rapier", "version": after.split('"').next(),
        "joints": ["ball", "hinge", "slide", "weld", "free"], "has": ["trees", "loads"],
        "quantities": ["joint_acceleration"], "ball_rates": "relative, far axes",
        "gaps": {"point masses": "Rapier takes a body without inertia about an axis as one that cannot turn about it"}
    })
}

fn number(v: &Value) -> f64 {
    v.as_f64().expect("a number")
}
fn vector(v: &Value) -> Vector {
    Vector::new(number(&v[0]), number(&v[1]), number(&v[2]))
}
fn rotation(p: &Value) -> Rotation {
    Rotation::from_xyzw(number(&p[1]), number(&p[2]), number(&p[3]), number(&p[0]))
}

/// The axes that a joint leaves free; only they have coordinates.
fn free_axes(kind: &str) -> JointAxesMask {
    match kind {
        "hinge" => JointAxesMask::ANG_Z,
        "slide" => JointAxesMask::LIN_Z,
        "ball" => JointAxesMask::ANG_X | JointAxesMask::ANG_Y | JointAxesMask::ANG_Z,
        "weld" => JointAxesMask::empty(),
        _ => JointAxesMask::all(),
    }
}

/// The accelerations of the joint coordinates at a state, joint by joint.
fn evaluate(model: &Value, state: &Value) -> Vec<f64> {
    let (mut bodies, mut joints) = (RigidBodySet::new(), MultibodyJointSet::new());
    let world = bodies.insert(RigidBodyBuilder::fixed());
    let kinds: Vec<&str> = model["kind"].as_array().unwrap().iter().map(|k| k.as_str().unwrap()).collect();
    let attitude = |b: i64| if b < 0 { Rotation::IDENTITY } else { rotation(&state["p"][b as usize]) };
    let spin = |b: i64| if b < 0 { Vector::ZERO } else { attitude(b) * vector(&state["omega"][b as usize]) };
    let (mut handles, mut links): (Vec<RigidBodyHandle>, Vec<MultibodyJointHandle>) = (vec![], vec![]);
    let mut displacements: Vec<Vec<f64>> = vec![];
    let mut rates: Vec<Vec<f64>> = vec![];
    for (k, kind) in kinds.iter().enumerate() {
        let inertia = &model["inertia"][k];
        let columns = Matrix::from_cols(vector(&inertia[0]), vector(&inertia[1]), vector(&inertia[2]));
        let own = MassProperties::with_inertia_matrix(Vector::ZERO, number(&model["mass"][k]), columns);
        let body = bodies.insert(RigidBodyBuilder::dynamic().additional_mass_properties(own).can_sleep(false));
        let (p, w, v) = (attitude(k as i64), vector(&state["omega"][k]), vector(&state["v"][k]));
        let load = vector(&model["force"][k]) - v * number(&model["drag_force"][k]);
        let moment = vector(&model["moment"][k]) - w * number(&model["drag_moment"][k]);
        bodies[body].add_force(load, true);
        bodies[body].add_torque(p * moment, true);
        let far = model["body"][k][0].as_i64().unwrap();
        let turned = *kind != "ball" && *kind != "free";
        let frame = |side: usize| {
            let axes = if turned { rotation(&model["turn"][k][side]) } else { Rotation::IDENTITY };
            Pose::from_parts(vector(&model["point"][k][side]), axes)
        };
        let joint = GenericJointBuilder::new(!free_axes(kind)).local_frame1(frame(0)).local_frame2(frame(1));
        let parent = if far < 0 { world } else { handles[far as usize] };
        links.push(joints.insert(parent, body, joint.build(), true).expect("a tree"));
        handles.push(body);
        let above = attitude(far).inverse();
        let relative = if far < 0 { p } else { (above * p).normalize() };
        let turn = relative.to_scaled_axis().to_array().to_vec();
        let relative_spin = (above * (spin(k as i64) - spin(far))).to_array().to_vec();
        displacements.push(match *kind {
            "ball" => turn,
            "free" => [vector(&state["r"][k]).to_array().to_vec(), turn].concat(),
            "weld" => vec![],
            _ => vec![number(&state["x"][k][0])],
        });
        rates.push(match *kind {
            "ball" => relative_spin,
            "free" => [v.to_array().to_vec(), relative_spin].concat(),
            "weld" => vec![],
            _ => vec![number(&state["xdot"][k][0])],
        });
    }
    let (tree, _) = joints.get_mut(links[0]).expect("a tree");
    tree.forward_kinematics(&bodies, true); // which takes the freedom of a moving body from the world's link
    tree.damping_mut().fill(0.0); // by default joints have some
    let places: Vec<usize> = (1..tree.num_links()).map(|i| tree.link(i).unwrap().assembly_id()).collect();
    let (mut moved, mut moving) = (vec![0.0; tree.ndofs()], vec![0.0; tree.ndofs()]);
    for (k, &at) in places.iter().enumerate() {
        moved[at..at + rates[k].len()].copy_from_slice(&displacements[k]);
        moving[at..at + rates[k].len()].copy_from_slice(&rates[k]);
    }
    tree.apply_displacements(&moved);
    tree.generalized_velocity_mut().copy_from_slice(&moving);
    tree.forward_kinematics(&bodies, false);
    tree.update_rigid_bodies(&mut bodies, true);
    let step = IntegrationParameters { dt: STEP, ..Default::default() };
    PhysicsPipeline::new().step(
        vector(&model["gravity"]), &step, &mut IslandManager::new(), &mut BroadPhaseBvh::new(),
        &mut NarrowPhase::new(), &mut bodies, &mut ColliderSet::new(), &mut ImpulseJointSet::new(),
        &mut joints, &mut SoftBodySet::new(), &mut CCDSolver::new(), &(), &(),
    );
    let (tree, _) = joints.get(links[0]).expect("a tree");
    let all = tree.generalized_acceleration();
    let mut found = vec![];
    for (k, &at) in places.iter().enumerate() {
        let mut own: Vec<f64> = (0..rates[k].len()).map(|i| all[at + i]).collect();
        if kinds[k] == "free" {
            let spun = attitude(k as i64).inverse() * Vector::new(own[3], own[4], own[5]);
            own[3..].copy_from_slice(&spun.to_array());
        }
        found.extend(own);
    }
    found
}

fn main() {
    let mut model = Value::Null;
    for line in stdin().lock().lines() {
        let mut question: Value = serde_json::from_str(&line.expect("UTF-8")).expect("a line of JSON");
        let mut answer = match question["ask"].as_str() {
            Some("hello") => hello(),
            Some("echo") => json!({"values": question["values"]}),
            Some("model") => {
                model = question["model"].take();
                json!({})
            }
            Some("evaluate") => {
                let states = question["states"].as_array().expect("states");
                let all: Vec<Value> =
                    states.iter().map(|one| json!({"joint_acceleration": evaluate(&model, one)})).collect();
                json!({"answers": all})
            }
            _ => json!({"unsupported": "this server evaluates states"}),
        };
        answer["id"] = question["id"].take();
        writeln!(stdout(), "{answer}").expect("somebody listens");
        stdout().flush().expect("somebody listens");
    }
}
