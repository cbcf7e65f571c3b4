"""Where a physics step's time goes, and what cheaper settings cost: `python experiments/physics_cost.py`.

Plain MuJoCo on one thread steps the states the shipped base meets, for one control step of four physics steps. Each
variant of the model is timed in turn with the preset's, and its end states are compared with those of a solver that
has all the iterations it wants. Run it with nothing else on the cores; `--draw` rewrites the page from the JSON alone.
"""

from __future__ import annotations

import copy
import statistics
import time
from pathlib import Path

import numpy as np

from forgetmimic_jax.studies.study import measured_page

HERE = Path(__file__).parent
RESULT = HERE / "results" / "physics_cost.json"
PAGE = HERE / "physics_cost.md"
STATES, SETTLING, REPEATS = 256, 8, 15

TEXT = """# What a physics step costs

MuJoCo {mujoco}, the G1 with {joints} joints in {states} states that the shipped base meets on all clips, one thread;
{contacts:.1f} contacts, {constraints:.1f} constraint rows and {iterations:.1f} solver iterations a step on average.
`.venv/bin/python experiments/physics_cost.py` measures it again (a minute), `--draw` rewrites this page from
`results/physics_cost.json`.

| part of a step | share |
|---|---|
{parts}

| variant | time | joint position off, 99th percentile | joint velocity off, 99th percentile |
|---|---|---|---|
{variants}

Time: over the preset's, median of {repeats} alternating rounds. Off: largest over the coordinates after one control
step, in rad or m and per s, from a Newton solver with 100 iterations.

{threads:.2f} times as many steps a second on two threads as on one. What is exact saves a few percent and no more;
what is cheaper changes the contact. So the engine keeps MuJoCo's settings as the paper has them.
"""


def measure() -> dict:
    """Collect states, then time and compare the variants."""
    import jax
    import jax.numpy as jnp
    import mujoco
    import mujoco.batch

    from forgetmimic_jax.evaluation.rollout import act, begin_episodes, evaluation_config
    from forgetmimic_jax.tracking import env as tracking
    from forgetmimic_jax.training import checkpoint, runner

    base = runner.base_folder("g1")
    config = evaluation_config(checkpoint.read_info(base).config)
    setup = runner.make_setup(config)
    policy = checkpoint.load_policy(base, runner.template(setup))
    env, assets, model = tracking.make_environment(config, setup.robot, STATES), setup.assets, setup.robot.model
    clip = np.arange(STATES) % len(setup.library.names)
    length = np.asarray(setup.library.length)[clip]
    frame = (np.random.default_rng(0).random(STATES) * (length - 2 * SETTLING)).astype(int)

    @jax.jit
    def step(assets, state, key):
        action = act(env, policy, tracking.observe(env, assets, state, None)[0])
        target = tracking.lookup(assets.library, state.clip, state.frame + 1).joint_pos
        return tracking.step(env, assets, state, action, key)[0], target + assets.robot.action_scale * action

    state = begin_episodes(env, assets, jax.random.PRNGKey(0), jnp.asarray(clip), jnp.asarray(frame))
    state = tracking.refresh_bodies(env, state, jnp.ones((STATES,), bool))
    for key in jax.random.split(jax.random.PRNGKey(1), SETTLING):
        state, _ = step(assets, state, key)
    _, target = step(assets, state, key)
    start = tuple(np.asarray(x, np.float64) for x in (*jax.tree.leaves(state.physics), target))

    def variant(flags: int = 0, **options):
        changed = copy.copy(model)
        for name, value in options.items():
            setattr(changed.opt, name, value)
        changed.opt.disableflags |= flags
        return changed

    substeps, off = config.physics.substeps, mujoco.mjtDisableBit
    variants = {
        "preset": variant(),
        "100 iterations, 50 of line search": variant(iterations=100, ls_iterations=50),
        "3 iterations": variant(iterations=3),
        "8 iterations of line search": variant(ls_iterations=8),
        "tolerance 1e-5": variant(tolerance=1e-5),
        "PGS solver": variant(solver=mujoco.mjtSolver.mjSOL_PGS),
        "CG solver": variant(solver=mujoco.mjtSolver.mjSOL_CG),
        "elliptic friction cone": variant(cone=mujoco.mjtCone.mjCONE_ELLIPTIC),
        "sparse Jacobian": variant(jacobian=mujoco.mjtJacobian.mjJAC_SPARSE),
        "no warm start": variant(int(off.mjDSBL_WARMSTART)),
        "no contact sensors": variant(int(off.mjDSBL_SENSOR)),
        "no contacts": variant(int(off.mjDSBL_CONTACT)),
        "no constraints at all": variant(int(off.mjDSBL_CONSTRAINT)),
        "half as many steps of 10 ms": variant(timestep=2 * model.opt.timestep),
    }

    def run(batch, nstep: int) -> float:
        batch.qpos[:], batch.qvel[:], batch.qacc_warmstart[:], batch.ctrl[:] = start
        begin = time.process_time()
        batch.step(nstep=nstep, stage=int(mujoco.mjtStage.mjSTAGE_VEL))
        return time.process_time() - begin

    batches = {name: mujoco.batch.Batch(changed, STATES, 1) for name, changed in variants.items()}
    steps = {name: round(substeps * model.opt.timestep / changed.opt.timestep) for name, changed in variants.items()}
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(REPEATS):
        for name, batch in batches.items():
            seconds[name].append(run(batch, steps[name]))
    truth = batches["100 iterations, 50 of line search"]
    rows = {}
    for name, batch in batches.items():
        ratios = [mine / preset for mine, preset in zip(seconds[name], seconds["preset"], strict=True)]
        apart = (np.abs(getattr(batch, field) - getattr(truth, field)).max(1) for field in ("qpos", "qvel"))
        rows[name] = [statistics.median(ratios), *(float(np.quantile(x, 0.99)) for x in apart)]
    return {"mujoco": mujoco.__version__, "joints": setup.robot.num_joints, "variants": rows} | _profile(model, start)


def _profile(model, start) -> dict:
    """Contacts, constraint rows, solver iterations and the shares of a step; how much a second thread brings."""
    import mujoco
    import mujoco.batch

    data, counts, substeps = mujoco.MjData(model), [], 4
    for row in zip(*start, strict=True):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = row
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            counts.append((data.ncon, data.nefc, data.solver_niter[0]))
    timer, kinds = data.timer, mujoco.mjtTimer
    whole = timer[int(kinds.mjTIMER_STEP)].duration
    names = {
        "kinematics": (kinds.mjTIMER_POS_KINEMATICS,),
        "inertia": (kinds.mjTIMER_POS_INERTIA,),
        "collision": (kinds.mjTIMER_POS_COLLISION,),
        "constraint rows": (kinds.mjTIMER_POS_MAKE, kinds.mjTIMER_POS_PROJECT),
        "velocity and actuators": (kinds.mjTIMER_VELOCITY, kinds.mjTIMER_ACTUATION),
        "constraint solver": (kinds.mjTIMER_CONSTRAINT,),
        "integrator": (kinds.mjTIMER_ADVANCE,),
    }
    shares = {name: sum(timer[int(kind)].duration for kind in group) / whole for name, group in names.items()}
    shares["the rest"] = 1.0 - sum(shares.values())
    batches = {threads: mujoco.batch.Batch(model, len(start[0]), threads) for threads in (1, 2)}
    wall: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(REPEATS):
        for threads, batch in batches.items():
            batch.qpos[:], batch.qvel[:], batch.qacc_warmstart[:], batch.ctrl[:] = start
            begin = time.perf_counter()
            batch.step(nstep=substeps, stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            wall[threads].append(time.perf_counter() - begin)
    contacts, constraints, iterations = np.mean(counts, axis=0).tolist()
    return {
        "shares": shares,
        "contacts": contacts,
        "constraints": constraints,
        "iterations": iterations,
        "threads": statistics.median(one / two for one, two in zip(wall[1], wall[2], strict=True)),
    }


def page(found: dict) -> str:
    """The page of the stored numbers."""
    variants = [f"| {name} | {row[0]:.2f} | {row[1]:.1e} | {row[2]:.1e} |" for name, row in found["variants"].items()]
    return TEXT.format(
        **{name: found[name] for name in ("mujoco", "joints", "contacts", "constraints", "iterations", "threads")},
        parts="\n".join(f"| {name} | {share:.0%} |" for name, share in found["shares"].items()),
        variants="\n".join(variants),
        states=STATES,
        repeats=REPEATS,
    )


if __name__ == "__main__":
    measured_page(measure, page, RESULT, PAGE)
