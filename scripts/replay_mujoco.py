#!/usr/bin/env python3
"""Replays recorded grasps in MuJoCo: does a second physics engine lift the object too?

    vergence experiment 2 --seeds 5 --save runs
    python scripts/replay_mujoco.py crates/sim/assets/workcell.urdf runs/*/replay.json

In: the robot's URDF (links base, hand, left_finger, right_finger) and recordings as written by
`vergence_physics::recording`. Out: a line for each recording and exit status 1 when one was not lifted.
Arm and fingers have the URDF's shapes and masses. The arm's joints follow the recorded angles as stiff
servos; the fingers are driven by a force through a spindle that keeps them centred. Needs the package
`mujoco` from PyPI.
"""

import argparse
import json
import sys

import mujoco
import numpy as np

STEP = 0.001            # s
TABLE_FRICTION = 0.3
FINGER_SPEED = 0.03     # m/s
RISEN = 0.8             # part of the hand's lift that the object must rise
HOLD = 1.0              # s
HAND = ("hand", "left_finger", "right_finger")


def add_solid(spec, body, solid, name, **properties):
    """Adds a geom to a body from its JSON description."""
    pose = solid["pose"]
    common = dict(name=name, pos=pose[:3], quat=pose[3:], **properties)
    if "box" in solid:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=solid["box"], **common)
    elif "cylinder" in solid:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=solid["cylinder"] + [0], **common)
    elif "sphere" in solid:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=solid["sphere"] + [0, 0], **common)
    else:
        mesh = spec.add_mesh(name=name, uservert=np.asarray(solid["hull"], float).ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **common)


def build(urdf, recording):
    """The robot of the URDF, the obstacles and the object as one model."""
    spec = mujoco.MjSpec.from_file(urdf)
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    # The heads' links tell no mass; they hang on joints that nothing drives here.
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Elliptic cones and many impratio: fingers hold without creeping.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 20
    friction = recording["object"]["friction"]
    # Contact bits: robot 1, rest 2. The robot does not meet itself; its planner has seen to that.
    # What stands still or belongs to the heads meets nothing.
    for body in spec.bodies:
        for geom in body.geoms:
            moves = body.name.startswith("arm_link") or body.name in HAND
            geom.contype, geom.conaffinity = (1, 2) if moves else (0, 0)
            if body.name.endswith("_finger"):
                geom.friction = [friction, 0.002, 0.0001]
                geom.priority = 1
                geom.condim = 4
    for n, solid in enumerate(recording["obstacles"]):
        add_solid(spec, spec.worldbody, solid, f"obstacle{n}", contype=2, conaffinity=3,
                  friction=[TABLE_FRICTION, 0.002, 0.0001])
    pose = recording["object"]["pose"]
    thing = spec.worldbody.add_body(name="object", pos=pose[:3], quat=pose[3:])
    thing.add_freejoint()
    for n, solid in enumerate(recording["object"]["solids"]):
        add_solid(spec, thing, solid, f"object{n}", contype=2, conaffinity=3,
                  friction=[TABLE_FRICTION, 0.002, 0.0001])
    model = spec.compile()
    body = model.body("object").id
    model.body_inertia[body] *= recording["object"]["mass"] / model.body_mass[body]
    model.body_mass[body] = recording["object"]["mass"]
    return model


class Replay:
    """Steps the model through a recording's motions."""

    def __init__(self, model, start):
        self.model, self.data = model, mujoco.MjData(model)
        joint = lambda name: model.joint(name)
        arm = [joint(f"arm_joint_{k}") for k in range(1, 7)]
        self.arm_q = np.array([j.qposadr[0] for j in arm])
        self.arm_v = np.array([j.dofadr[0] for j in arm])
        fingers = [joint("left_finger_joint"), joint("right_finger_joint")]
        self.finger_q = np.array([j.qposadr[0] for j in fingers])
        self.finger_v = np.array([j.dofadr[0] for j in fingers])
        self.travel = fingers[0].range[1]
        self.wanted = np.array(start)
        self.goal, self.force, self.spindle = self.travel, 0.0, self.travel
        self.data.qpos[self.arm_q] = start
        self.data.qpos[self.finger_q] = self.travel
        mujoco.mj_forward(model, self.data)
        self.bump = 0.0
        self.watching = True

    def step(self, wanted):
        data, model = self.data, self.model
        velocity = (wanted - self.wanted) / STEP
        self.wanted = wanted
        data.qfrc_applied[:] = 0.0
        # Stiff servos through the arm's inertia, gravity compensated, as an industrial controller does.
        acceleration = (4e4 * (wanted - data.qpos[self.arm_q])
                        + 400.0 * (velocity - data.qvel[self.arm_v]))
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        torque = mass[np.ix_(self.arm_v, self.arm_v)] @ acceleration
        data.qfrc_applied[self.arm_v] = torque + data.qfrc_bias[self.arm_v]
        # The spindle moves to its goal, held back where the fingers' springs reach the force.
        stiffness, damping = 20000.0, 80.0
        fingers = data.qpos[self.finger_q]
        step = FINGER_SPEED * STEP
        before = self.spindle
        target = np.clip(self.goal, before - step, before + step)
        furthest = fingers.mean() - self.force / stiffness
        self.spindle = min(furthest, before + step) if target < furthest else target
        speed = (self.spindle - before) / STEP
        spring = stiffness * (self.spindle - fingers) + damping * (speed - data.qvel[self.finger_v])
        data.qfrc_applied[self.finger_v] = spring + data.qfrc_bias[self.finger_v]
        mujoco.mj_step(model, data)
        if self.watching:
            self.watch()

    def watch(self):
        """Strongest force between the robot and anything else."""
        wrench = np.zeros(6)
        for n in range(self.data.ncon):
            geoms = self.data.contact[n].geom
            if (self.model.geom_contype[geoms] == 1).any():
                mujoco.mj_contactForce(self.model, self.data, n, wrench)
                self.bump = max(self.bump, abs(wrench[0]))

    def move(self, times, positions):
        positions = np.asarray(positions)
        for t in np.arange(STEP, times[-1] + STEP, STEP):
            self.step(np.array([np.interp(t, times, positions[:, k]) for k in range(6)]))

    def grip(self, width, force):
        self.goal, self.force = width / 2.0, force
        for _ in range(int(3.0 / STEP)):
            self.step(self.wanted)

    def height(self, name):
        return self.data.body(name).xpos[2]


def replay(urdf, recording):
    """How far object and hand rose (m), and the force of the worst bump before closing (N)."""
    run = Replay(build(urdf, recording), recording["start"])
    motions = recording["motions"]
    low = hand = None
    for motion in motions:
        if "grip" in motion:
            closing = motion["grip"]["width"] == 0.0
            if closing:
                run.watching = False
                low, hand = run.height("object"), run.height("hand")
            run.grip(motion["grip"]["width"], motion["grip"]["force"])
        else:
            run.move(motion["move"]["times"], motion["move"]["positions"])
    for _ in range(int(HOLD / STEP)):
        run.step(run.wanted)
    return run.height("object") - low, run.height("hand") - hand, run.bump


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("urdf")
    parser.add_argument("recordings", nargs="+")
    arguments = parser.parse_args()
    lifted = 0
    for path in arguments.recordings:
        with open(path) as file:
            recording = json.load(file)
        risen, hand, bump = replay(arguments.urdf, recording)
        good = hand > 0.01 and risen > RISEN * hand
        lifted += good
        print(f"{path}: {'lifted' if good else 'NOT LIFTED'}, the object rose {risen * 1e3:.0f} mm, "
              f"the hand {hand * 1e3:.0f} mm, worst bump {bump:.1f} N")
    print(f"{lifted} of {len(arguments.recordings)} lifted")
    return 0 if lifted == len(arguments.recordings) else 1


if __name__ == "__main__":
    sys.exit(main())
