"""The Runge-Kutta substep is `mj_step`'s, to rounding, with the forces that Gymnasium computes."""

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.physics.runge_kutta import runge_kutta_substep

BODY = """
<mujoco>
  <option integrator="RK4" timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="torso" pos="0 0 {height}">
      {root}
      <geom type="box" size="0.3 0.2 0.1"/>
      <body pos="0.3 0 0">
        <joint type="hinge" axis="0 1 0" range="-40 40" limited="true" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/>
      </body>
    </body>
  </worldbody>
  <sensor><framelinacc objtype="xbody" objname="torso"/></sensor>
</mujoco>
"""
ROOTS = {
    "free": "<freejoint/>",
    "planar": '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>',
}
OUTPUTS = ("qacc", "cfrc_ext", "cvel", "cinert", "xpos")
NUM_ENVS = 16


def make(root, height):
    model = mujoco.MjModel.from_xml_string(BODY.format(root=ROOTS[root], height=height))
    return model, BatchPhysics(model, NUM_ENVS, 1, OUTPUTS)


def start(model, physics, spin):
    """Random velocities, `spin` rad/s about the root's axes where it turns."""
    draw = np.random.default_rng(0)
    physics.qvel.copy_(torch.from_numpy(draw.normal(size=(NUM_ENVS, model.nv))))
    if model.nq > model.nv:
        axis = draw.normal(size=(NUM_ENVS, 3))
        axis *= spin / np.linalg.norm(axis, axis=-1, keepdims=True)
        physics.qvel[:, 3:6] = torch.from_numpy(axis)
        physics.qpos[:, 3:7] = torch.from_numpy(draw.normal(size=(NUM_ENVS, 4)))


def reference(model, physics, row, num_substeps):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = physics.qpos[row].numpy(), physics.qvel[row].numpy()
    mujoco.mj_step(model, data, nstep=num_substeps)
    mujoco.mj_rnePostConstraint(model, data)
    return data


@pytest.mark.parametrize("height", [0.09, 3.0])
@pytest.mark.parametrize(
    ("root", "spin"), [("free", 0.0), ("free", 1e-4), ("free", 0.1), ("free", 60.0), ("planar", 0)]
)
def test_it_is_what_mujoco_does(root, spin, height):
    model, physics = make(root, height)
    start(model, physics, spin)
    wanted = [reference(model, physics, row, 3) for row in range(NUM_ENVS)]
    for _ in range(3):
        assert not runge_kutta_substep(physics).any()
    for row, data in enumerate(wanted):
        state = ("qpos", "qvel", "qacc_warmstart")
        for name in (*state, "cfrc_ext", "cvel", "cinert", "xpos"):
            ours = getattr(physics, name) if name in state else physics.outputs[name]
            theirs = getattr(data, name)
            assert np.allclose(ours[row].numpy(), theirs, rtol=1e-8, atol=1e-8), name
        assert physics.time[row].item() == pytest.approx(data.time, abs=1e-12)
    touching = any(np.abs(data.cfrc_ext).max() > 1.0 for data in wanted)
    assert touching == (height < 1.0)


def test_failed_simulations_start_over_alone():
    model, physics = make("free", 1.0)
    start(model, physics, 1.0)
    physics.qvel[3, 0] = float("nan")
    physics.qvel[5, 2] = 1e12
    assert runge_kutta_substep(physics).nonzero()[:, 0].tolist() == [3, 5]
    for row in (3, 5):
        assert np.array_equal(physics.qpos[row].numpy(), model.qpos0)
        assert not physics.qvel[row].any()
    assert all(physics.outputs[name].isfinite().all() for name in OUTPUTS)
    assert not runge_kutta_substep(physics).any()


def test_gymnasium_uses_the_integrator_that_this_stands_for():
    """The Ant and the Humanoid: were they no longer, forces would have to come from elsewhere."""
    for name in ("Ant-v5", "Humanoid-v5"):
        model = gymnasium.make(name).unwrapped.model
        assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        assert model.na == 0
