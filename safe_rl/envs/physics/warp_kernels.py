"""Additional kernels of a step on MuJoCo Warp: one thread per simulation, or per number."""

# Annotations of Warp's kernels are objects, which mypy does not accept as types.
# mypy: ignore-errors
import mujoco
import warp as wp

wp.set_module_options({"enable_backward": False})

_PLANE = wp.constant(int(mujoco.mjtGeom.mjGEOM_PLANE))
_CAPSULE = wp.constant(int(mujoco.mjtGeom.mjGEOM_CAPSULE))
_VERTICAL = wp.constant(1e-6)


@wp.kernel
def follow_path(path: wp.array3d(dtype=float), substep: int, live: wp.array2d(dtype=float)):
    """Copy the positions of a substep: path [N, S, K] -> live [N, K]."""
    world, column = wp.tid()
    live[world, column] = path[world, substep, column]


@wp.kernel
def reset_rows(
    mask: wp.array(dtype=wp.bool), start: wp.array(dtype=float), live: wp.array2d(dtype=float)
):
    """Write initial values [K] into the worlds of a mask [N]: live [N, K]."""
    world, column = wp.tid()
    if mask[world]:
        live[world, column] = start[column]


@wp.kernel
def align_capsules(
    num_contacts: wp.array(dtype=int),
    geom_type: wp.array(dtype=int),
    geoms: wp.array(dtype=wp.vec2i),
    worlds: wp.array(dtype=int),
    geom_xmat: wp.array2d(dtype=wp.mat33),
    frames: wp.array(dtype=wp.mat33),
):
    """Align the contact frames of capsules on planes with the capsule, as MuJoCo does.

    MuJoCo Warp 4.0.0 does so only for capsules that lie flatter than 60 degrees. Pyramidal friction
    cones depend on the direction of the frame.
    """
    contact = wp.tid()
    if contact >= num_contacts[0]:
        return
    plane, capsule = geoms[contact][0], geoms[contact][1]
    if plane < 0 or capsule < 0:
        return
    if geom_type[plane] != _PLANE or geom_type[capsule] != _CAPSULE:
        return
    turn = geom_xmat[worlds[contact], capsule]
    axis = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    frame = frames[contact]
    normal = wp.vec3(frame[0, 0], frame[0, 1], frame[0, 2])
    along = axis - normal * wp.dot(normal, axis)
    if wp.length(along) < _VERTICAL:
        return
    along = wp.normalize(along)
    across = wp.cross(normal, along)
    frames[contact] = wp.matrix_from_rows(normal, along, across)


@wp.kernel
def find_failures(live: wp.array2d(dtype=float), largest: float, failed: wp.array(dtype=wp.bool)):
    """Mark worlds with a number that is too large or not a number."""
    world, column = wp.tid()
    if not (wp.abs(live[world, column]) < largest):
        failed[world] = True
