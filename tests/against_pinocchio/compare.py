"""Compares `delmpc model --at` with Pinocchio: see README.md."""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import pinocchio as pin

BOUND = 1e-9


def ask(program, urdf, question, accept):
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(question, file)
        file.flush()
        options = ["--accept-impossible-inertia"] if accept else []
        done = subprocess.run([program, "model", urdf, "--at", file.name, *options], capture_output=True, text=True)
    if done.returncode != 0:
        return None, done.stderr.strip().splitlines()[0]
    return json.loads(done.stdout), None


def relative(ours, theirs):
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    scale = max(np.abs(theirs).max(initial=0.0), 1e-12)
    return np.abs(ours - theirs).max(initial=0.0) / scale


def compare(program, urdf, seed, accept):
    """Largest relative difference, or why there is none."""
    zero, reason = ask(program, urdf, {}, accept)
    if zero is None:
        return "refused", reason
    root = pin.JointModelFreeFlyer() if zero["floating"] else None
    try:
        model = pin.buildModelFromUrdf(urdf, root) if root else pin.buildModelFromUrdf(urdf)
    except Exception as error:  # noqa: BLE001 - whatever it says, there is nothing to compare with
        return "not read by Pinocchio", str(error).splitlines()[0]
    ours = zero["joints"]
    joints = [name for name in model.names[1:] if name != "root_joint"]
    if not set(ours) <= set(joints):
        return "other coordinates", ", ".join(sorted(set(ours) - set(joints))[:3])
    # Joints that are held on our side: their coordinate stays 0.
    held = [name for name in joints if name not in ours]
    random = np.random.default_rng(seed)
    q, values = pin.neutral(model), {}
    for name in ours:
        joint = model.joints[model.getJointId(name)]
        angle = random.uniform(-1.0, 1.0)
        values[name] = angle
        if joint.nq == 2:
            q[joint.idx_q : joint.idx_q + 2] = [np.cos(angle), np.sin(angle)]
        else:
            q[joint.idx_q] = angle
    question = {"q": values}
    if root:
        quaternion = random.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        position = random.uniform(-1.0, 1.0, size=3)
        q[:3], q[3:7] = position, quaternion
        question["base_pose"] = {"xyz": position.tolist(), "quaternion_xyzw": quaternion.tolist()}
    question["gravity"] = [0.0, 0.0, -9.81]
    answer, reason = ask(program, urdf, question, accept)
    if answer is None:
        return "refused", reason
    data = model.createData()
    pin.crba(model, data, q)
    mass_matrix = np.triu(data.M) + np.triu(data.M, 1).T
    gravity = pin.computeGeneralizedGravity(model, data, q)
    com = pin.centerOfMass(model, data, q)
    # Ours: angular before linear, joints in our order.
    order = ([3, 4, 5, 0, 1, 2] if root else []) + [model.joints[model.getJointId(name)].idx_v for name in ours]
    # A robot that is fixed to the world has mass in it that does not move; Pinocchio counts it by its own rules.
    total = sum(inertia.mass for inertia in model.inertias)
    figures = {
        "mass matrix": relative(answer["mass_matrix"], mass_matrix[np.ix_(order, order)]),
        "gravity": relative(answer["gravity_torque"], gravity[order]),
    }
    if root:
        figures["mass"] = relative(answer["total_mass"], total)
        figures["mass centre"] = np.abs(np.array(answer["com"]) - com).max()
    worst = max(figures, key=figures.get)
    return figures[worst], f"{worst}, {len(ours)} joints" + (f", {len(held)} held" if held else "")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program")
    parser.add_argument("paths", nargs="+", type=pathlib.Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--refused", type=float, default=5.0, help="percent of the files that may be refused")
    parser.add_argument("--accept", action="store_true", help="with --accept-impossible-inertia")
    arguments = parser.parse_args()
    files = sorted(f for path in arguments.paths for f in ([path] if path.is_file() else path.rglob("*.urdf")))
    kinds, worst, failed = {}, 0.0, False
    for file in files:
        result, note = compare(arguments.program, str(file), arguments.seed, arguments.accept)
        if isinstance(result, str):
            kinds.setdefault(result, []).append(file)
            print(f"{file.name}: {result}: {note}")
            continue
        kinds.setdefault("compared", []).append(file)
        worst = max(worst, result)
        failed |= not result <= BOUND
        print(f"{file.name}: {result:.1e} ({note}){'' if result <= BOUND else '   DIFFERS'}")
    print(f"\n{len(files)} files: " + ", ".join(f"{len(of)} {kind}" for kind, of in kinds.items()))
    print(f"worst relative difference {worst:.1e}, bound {BOUND:.0e}")
    refused = 100.0 * len(kinds.get("refused", [])) / max(len(files), 1)
    if refused > arguments.refused:
        print(f"{refused:.1f} % refused, at most {arguments.refused} %")
        failed = True
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
