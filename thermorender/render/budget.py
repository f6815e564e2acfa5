"""The error budget of a frame: an estimate of what its radiance errs by, cause by cause, in mK at 300 K."""

import drjit as dr
import numpy as np

from thermorender.render.geometry import opaque_view, view_ray
from thermorender.render.sampling import contrast, edge_estimate, texture_estimate

# Every how many pixels the light's error is looked up.
_PIXELS = 16


def budget_mk(baked, rays, pose, radiance, sampling):
    """Return {cause: estimated root mean square error [mK]} of a frame, as `Frame.budget_mk` has it.

    Parameters
    ----------
    baked : BakedScene
    rays : CameraRays
    pose : (4, 4) array
        world_from_camera.
    radiance : (H, W) float32
        [W m⁻² sr⁻¹].
    sampling : Sampling
    """
    plan, device = baked.plan, baked.device
    mi, per_mk = device.geometry.mi, plan.radiance_per_mk
    span = contrast(radiance)
    # Where nothing was asked about edges, any contrast may be one.
    step = span if sampling.step is None else sampling.step
    edges = edge_estimate(step, plan.samples).ravel()
    for pixels, left, count in sampling.refined:
        edges[pixels] = edge_estimate(left, count)
    texture = texture_estimate(span - step, plan.samples * plan.taps)
    light = 0.0
    if device.face_error is not None:
        # Of the faces that some of the pixels show; what differs within the faces is known of the scene only.
        slope = rays.slopes(0.5, 0.5, dr.arange(mi.UInt32, 0, len(rays.order), _PIXELS))
        hit = device.geometry.cast(view_ray(mi, *opaque_view(mi, pose), *slope))
        shown = np.array(dr.gather(mi.Float, device.face_error, hit.face, hit.valid), dtype=np.float64)
        light = np.sqrt(shown.mean() / per_mk**2 + baked.errors_mk["faces"] ** 2)
    parts = {
        "nodes": plan.spectrum.nodes_mk + baked.errors_mk["solution"],
        "bake": float(light),
        "sampling": float(np.sqrt(np.mean(edges**2) + np.mean(texture**2)) / per_mk),
    }
    if baked.scene.air is not None:
        parts["air"] = plan.spectrum.channels_mk
    if plan.specular:
        parts["mirrors"] = plan.specular.error_mk
    return {**parts, "total": float(np.sqrt(sum(value**2 for value in parts.values())))}
