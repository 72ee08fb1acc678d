"""Renders the Gaussians of an ``.npz`` with Mitsuba, for `test_gaussian_mitsuba`: ``python mitsuba_ellipsoids.py IN OUT``.

The stock integrator composites a Gaussian twice where float32 hides that its shell has been left, and stops at a transmittance
of 1/100; this one skips the primitive that was last, and goes on to the end. Rays are given, through pixel centres.
"""

import sys

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
from mitsuba.python.ad.integrators.volprim_rf_basic import BasicVolumetricPrimitiveRadianceFieldIntegrator  # noqa: E402

EXTENT = 5.0
STEP = 1e-5


class EachOnce(BasicVolumetricPrimitiveRadianceFieldIntegrator):
    """The radiance-field integrator, every primitive once."""

    @dr.syntax
    def along(self, scene: mi.Scene, ray: mi.Ray3f) -> mi.Color3f:
        """Light along rays."""
        ray = mi.Ray3f(ray)
        active = mi.Bool(True)
        light = mi.Color3f(0.0)
        left = mi.Color3f(1.0)
        last = mi.UInt32(0xFFFFFFFF)
        while active:
            hit = scene.ray_intersect(ray, coherent=False, ray_flags=mi.RayFlags.All, active=active)
            active &= hit.is_valid()
            new = active & (hit.prim_index != last)
            through = self.eval_transmission(hit, ray, new)
            light = dr.select(new, light + left * (1.0 - through) * self.eval_sh_emission(hit, ray, new), light)
            left = dr.select(new, left * through, left)
            last = dr.select(active, hit.prim_index, last)
            ray.o = dr.select(active, hit.p + ray.d * STEP, ray.o)
        return light


def main(source: str, target: str) -> None:
    mi.register_integrator("each_once", EachOnce)
    data = np.load(source)
    shape = {"type": "ellipsoids", "extent": EXTENT}
    for name in ("centers", "scales", "quaternions", "opacities"):
        shape[name] = mi.TensorXf(data[name])
    shape["sh_coeffs"] = mi.TensorXf(data["sh"])
    scene = mi.load_dict({"type": "scene", "shape": shape})
    ray = mi.Ray3f(mi.Point3f(data["origins"].T), mi.Vector3f(data["directions"].T))
    integrator = mi.load_dict({"type": "each_once", "srgb_primitives": False})
    np.save(target, np.array(integrator.along(scene, ray)).T)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
