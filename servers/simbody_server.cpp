// Simbody as a server of protocol 1: states and runs of trees with loads.
//
// A body's frame B is at its centre of mass. Joint k connects F, at its far point with its axes there, to M, at
// its near point. Simbody slides along x, so a slide's frames are turned; a cylinder's turn comes first.
//
//     ball, free   setQToFit…, setUToFit… of M in F
//     joint        calcMobilizerReactionForces: on the near body, at M's origin, in world axes
//
// g++ -O2 -I/usr/include/simbody simbody_server.cpp -lSimTKsimbody -lSimTKmath -lSimTKcommon

#include <Simbody.h>

#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

using Json = nlohmann::json;
using SimTK::MobilizedBody, SimTK::Rotation, SimTK::SpatialVec, SimTK::Transform, SimTK::Vec3;

const char* HELLO = R"({
    "protocol": 1, "name": "simbody", "title": "Simbody",
    "joints": ["ball", "hinge", "universal", "slide", "cylindrical", "weld", "free"], "has": ["trees", "loads"],
    "quantities": ["acceleration", "angular_acceleration", "joint_reaction", "joint_moment", "kinetic_energy",
                   "potential_energy", "angular_momentum"],
    "integrators": [
        {"name": "RungeKuttaMerson", "kind": "step", "order": 4, "error_exponents": [4, 5, 6, 7]},
        {"name": "SemiExplicitEuler", "kind": "step", "order": 1, "error_exponents": [1, 2, 3, 4]}
    ]
})";

Vec3 vector(const Json& v) { return {v[0].get<double>(), v[1].get<double>(), v[2].get<double>()}; }
Json plain(const Vec3& v) { return {v[0], v[1], v[2]}; }
Rotation rotation(const Json& p) {
    return Rotation(SimTK::Quaternion(p[0].get<double>(), p[1].get<double>(), p[2].get<double>(), p[3].get<double>()));
}

// Constant forces, moments that turn with the body, and drag.
struct Loads : SimTK::Force::Custom::Implementation {
    const SimTK::SimbodyMatterSubsystem& matter;
    const Json& model;
    Loads(const SimTK::SimbodyMatterSubsystem& matter, const Json& model) : matter(matter), model(model) {}
    void calcForce(const SimTK::State& state, SimTK::Vector_<SpatialVec>& bodies, SimTK::Vector_<Vec3>&,
                   SimTK::Vector&) const override {
        for (size_t k = 0; k < model["mass"].size(); ++k) {
            const MobilizedBody& body = matter.getMobilizedBody(SimTK::MobilizedBodyIndex(int(k) + 1));
            const Rotation& A = body.getBodyRotation(state);
            Vec3 omega = ~A * body.getBodyAngularVelocity(state);
            Vec3 moment = vector(model["moment"][k]) - model["drag_moment"][k].get<double>() * omega;
            Vec3 drag = model["drag_force"][k].get<double>() * body.getBodyOriginVelocity(state);
            bodies[int(k) + 1] += SpatialVec(A * moment, vector(model["force"][k]) - drag);
        }
    }
    double calcPotentialEnergy(const SimTK::State&) const override { return 0; }
};

struct Mechanism {
    Json model;
    SimTK::MultibodySystem system;
    SimTK::SimbodyMatterSubsystem matter{system};
    SimTK::GeneralForceSubsystem forces{system};
    std::vector<MobilizedBody> bodies;

    explicit Mechanism(const Json& given) : model(given) {
        SimTK::Force::UniformGravity(forces, matter, vector(model["gravity"]));
        SimTK::Force::Custom(forces, new Loads(matter, model));
        for (size_t k = 0; k < model["mass"].size(); ++k) {
            const Json& J = model["inertia"][k];
            SimTK::Inertia inertia(J[0][0], J[1][1], J[2][2], J[0][1], J[0][2], J[1][2]);
            SimTK::Body::Rigid body(SimTK::MassProperties(model["mass"][k], Vec3(0), inertia));
            bodies.push_back(joined(k, body));
        }
        system.realizeTopology();
    }

    std::string kind(size_t k) const { return model["kind"][k]; }

    MobilizedBody joined(size_t k, const SimTK::Body& body) {
        int far = model["body"][k][0];
        MobilizedBody parent = far < 0 ? MobilizedBody(matter.Ground()) : bodies[far];
        Rotation turn;  // x of a slide along the joint's z
        if (kind(k) == "slide") turn.setRotationFromAngleAboutY(-SimTK::Pi / 2);
        Transform ends[2];
        for (int i : {0, 1}) ends[i] = Transform(rotation(model["turn"][k][i]) * turn, vector(model["point"][k][i]));
        if (kind(k) == "ball") return MobilizedBody::Ball(parent, ends[0], body, ends[1]);
        if (kind(k) == "hinge") return MobilizedBody::Pin(parent, ends[0], body, ends[1]);
        if (kind(k) == "slide") return MobilizedBody::Slider(parent, ends[0], body, ends[1]);
        if (kind(k) == "universal") return MobilizedBody::Universal(parent, ends[0], body, ends[1]);
        if (kind(k) == "cylindrical") return MobilizedBody::Cylinder(parent, ends[0], body, ends[1]);
        if (kind(k) == "weld") return MobilizedBody::Weld(parent, ends[0], body, ends[1]);
        return MobilizedBody::Free(parent, Transform(), body, Transform());
    }

    SimTK::State at(const Json& given) const {
        SimTK::State state = system.getDefaultState();
        for (size_t k = 0; k < bodies.size(); ++k) {
            int far = model["body"][k][0];
            Rotation A = rotation(given["p"][k]), above = far < 0 ? Rotation() : rotation(given["p"][far]);
            Vec3 spin = A * vector(given["omega"][k]);
            Vec3 relative = spin - (far < 0 ? Vec3(0) : above * vector(given["omega"][far]));
            const MobilizedBody& body = bodies[k];
            if (kind(k) == "free") {
                body.setQToFitTransform(state, Transform(A, vector(given["r"][k])));
                body.setUToFitVelocity(state, SpatialVec(spin, vector(given["v"][k])));
            } else if (kind(k) == "ball") {
                Rotation F = above * rotation(model["turn"][k][0]);
                body.setQToFitRotation(state, ~F * A * rotation(model["turn"][k][1]));
                body.setUToFitAngularVelocity(state, ~F * relative);
            } else {
                int count = body.getNumQ(state);
                for (int i = 0; i < count; ++i) {
                    int own = kind(k) == "cylindrical" ? 1 - i : i;
                    body.setOneQ(state, i, given["x"][k][own]);
                    body.setOneU(state, i, given["xdot"][k][own]);
                }
            }
        }
        return state;
    }

    Json evaluate(const Json& given) const {
        SimTK::State state = at(given);
        system.realize(state, SimTK::Stage::Acceleration);
        SimTK::Vector_<SpatialVec> wrenches;
        matter.calcMobilizerReactionForces(state, wrenches);
        Json found;
        for (size_t k = 0; k < bodies.size(); ++k) {
            const Rotation& A = bodies[k].getBodyRotation(state);
            found["acceleration"].push_back(plain(bodies[k].getBodyOriginAcceleration(state)));
            found["angular_acceleration"].push_back(plain(~A * bodies[k].getBodyAngularAcceleration(state)));
            found["joint_moment"].push_back(plain(wrenches[int(k) + 1][0]));
            found["joint_reaction"].push_back(plain(wrenches[int(k) + 1][1]));
        }
        bool has_moments = false;
        for (const Json& one : model["kind"]) has_moments |= one.get<std::string>() != "ball";
        if (!has_moments) found.erase("joint_moment");
        found["kinetic_energy"] = system.calcKineticEnergy(state);
        found["potential_energy"] = system.calcPotentialEnergy(state);
        found["angular_momentum"] = plain(matter.calcSystemMomentumAboutGroundOrigin(state)[0]);
        return found;
    }

    Json simulate(const Json& question) const {
        std::unique_ptr<SimTK::Integrator> method;
        if (question["integrator"] == "SemiExplicitEuler") {
            method.reset(new SimTK::SemiExplicitEulerIntegrator(system, question["resolution"]));
        } else {
            method.reset(new SimTK::RungeKuttaMersonIntegrator(system));
            method->setFixedStepSize(question["resolution"]);
        }
        method->initialize(at(question["state"]));
        Json found;
        for (const Json& time : question["times"]) {
            while (method->getTime() < time.get<double>()) method->stepTo(time.get<double>());
            const SimTK::State& state = method->getState();
            system.realize(state, SimTK::Stage::Velocity);
            Json r, p, v, omega;
            for (const MobilizedBody& body : bodies) {
                const Rotation& A = body.getBodyRotation(state);
                SimTK::Quaternion q = A.convertRotationToQuaternion();
                r.push_back(plain(body.getBodyOriginLocation(state)));
                p.push_back({q[0], q[1], q[2], q[3]});
                v.push_back(plain(body.getBodyOriginVelocity(state)));
                omega.push_back(plain(~A * body.getBodyAngularVelocity(state)));
            }
            found["t"].push_back(method->getTime());
            found["r"].push_back(r), found["p"].push_back(p), found["v"].push_back(v);
            found["omega"].push_back(omega);
        }
        found["steps"] = method->getNumStepsTaken();
        return found;
    }
};

int main() {
    std::unique_ptr<Mechanism> mechanism;
    std::string line;
    while (std::getline(std::cin, line)) {
        Json question = Json::parse(line), answer = Json::object();
        std::string ask = question["ask"];
        try {
            if (ask == "hello") {
                answer = Json::parse(HELLO);
                int major, minor, build;
                SimTK_version_simbody(&major, &minor, &build);
                answer["version"] = std::to_string(major) + "." + std::to_string(minor);
            } else if (ask == "echo") {
                answer["values"] = question["values"];
            } else if (ask == "model") {
                mechanism.reset(new Mechanism(question["model"]));
            } else if (ask == "evaluate") {
                for (const Json& state : question["states"]) answer["answers"].push_back(mechanism->evaluate(state));
            } else {
                answer = mechanism->simulate(question);
            }
        } catch (const std::exception& error) {
            answer = {{"error", error.what()}};
        }
        answer["id"] = question["id"];
        std::cout << answer.dump() << std::endl;
    }
}
