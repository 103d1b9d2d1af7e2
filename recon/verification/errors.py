"""How large the errors of cameras may be: what three sources say, each of which is blind to something."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from splatnode.recon.geometry import compute_rms_radius
from splatnode.recon.registration.register import Registration
from splatnode.recon.verification import focal_profile, jackknife, principal_point, refit

# Aligned patches make sigmas smaller, but not the part that is of lenses, which may differ from image to image
LEAST_SHARPER = 0.5
MIN_SIGMA = 1e-9  # a smaller one counts as this where ratios are taken


@dataclass(frozen=True)
class Errors:
    """The size of one error as each source says it, as one standard error."""

    sigma: float  # the covariance of the bundle adjustment, which takes errors for independent
    regions: float  # what leaving out regions of the pictures changes (see jackknife.py)
    profile: float  # what unknown lenses leave open (see focal_profile.py and principal_point.py)


@dataclass(frozen=True)
class PoseErrors:
    """The errors of the pose of one camera."""

    rotation: Errors  # degrees, after the best common rotation
    centre: Errors  # after the best similarity; the distance to the scene is 1


@dataclass(frozen=True)
class AllErrors:
    cameras: Mapping[int, PoseErrors]  # by their keyframes' positions
    focals: Mapping[int, Errors]  # of the logarithms of their focal lengths, likewise

    @property
    def focal(self) -> Errors:
        """Returns the errors of the least certain focal length, by each source."""
        return combine_worst(self.focals.values())


def combine_worst(errors: Iterable[Errors]) -> Errors:
    """The largest of each source; NaN where one is."""
    found = np.array([(of.sigma, of.regions, of.profile) for of in errors])
    return Errors(*found.max(0).tolist())


def measure_errors(fit: refit.BundleFit, registration: Registration) -> AllErrors:
    """Measures the errors of the cameras of `registration`; `fit` has a part of its points."""
    regions, profile, freed = (
        jackknife.estimate_spread(fit),
        focal_profile.profile_focal(fit),
        principal_point.free_principal_points(fit),
    )
    turned, shifted = (profile.rotation_deg, profile.centre)
    if freed is not None:
        turned, shifted = np.maximum(turned, freed.rotation_deg), np.maximum(shifted, freed.centre)
    unit = compute_travel(registration)
    cameras = {
        camera.index: PoseErrors(
            rotation=Errors(camera.rotation_sigma_deg, regions.rotation_deg[i], float(turned[i])),
            centre=Errors(unit * camera.centre_sigma_rel, regions.centre[i], float(shifted[i])),
        )
        for i, camera in enumerate(registration.cameras)
    }
    lens_of = fit.problem.lens_of_camera
    focals = {
        camera.index: Errors(camera.focal_sigma, regions.focal_rel[lens_of[i]], profile.focal_rel[lens_of[i]])
        for i, camera in enumerate(registration.cameras)
    }
    return AllErrors(cameras, focals)


def compute_travel(registration: Registration) -> float:
    """RMS distance of the centres from their mean; the distance to the scene is 1."""
    centres = np.stack([camera.T_world_camera[:3, 3] for camera in registration.cameras])
    return compute_rms_radius(centres)


def extrapolate_pose_errors(registration: Registration, known: Mapping[int, PoseErrors]) -> dict[int, PoseErrors]:
    """Extrapolates the errors of a continuation's cameras, by keyframe, from the `known` ones of some.

    A continuation aligns no patches, so that its sigmas are too large: they shrink as much as those of the known
    cameras do. What is known of a camera besides stays. A further camera is taken for the worst of the known ones, and
    as much worse as its sigma is larger.
    """
    unit = compute_travel(registration)
    rotations = {camera.index: camera.rotation_sigma_deg for camera in registration.cameras}
    centres = {camera.index: unit * camera.centre_sigma_rel for camera in registration.cameras}
    of_rotations = _extrapolate_errors(rotations, {index: of.rotation for index, of in known.items()})
    of_centres = _extrapolate_errors(centres, {index: of.centre for index, of in known.items()})
    return {index: PoseErrors(of_rotations[index], of_centres[index]) for index in rotations}


def extrapolate_focal_errors(registration: Registration, known: Mapping[int, Errors]) -> dict[int, Errors]:
    """Extrapolates the focal errors of a continuation from the `known` ones; the larger sigma counts.

    A further camera has what is known of the least certain focal length.
    """
    least_certain = combine_worst(known.values())
    found = {}
    for camera in registration.cameras:
        was = known.get(camera.index, least_certain)
        found[camera.index] = replace(was, sigma=float(np.maximum(was.sigma, camera.focal_sigma)))
    return found


def _extrapolate_errors(sigmas: Mapping[int, float], known: Mapping[int, Errors]) -> dict[int, Errors]:
    ratios = [of.sigma / max(sigmas[index], MIN_SIGMA) for index, of in known.items()]
    sharper = float(np.clip(np.median(ratios), LEAST_SHARPER, 1.0))
    largest = Errors(*(max(getattr(of, part) for of in known.values()) for part in ("sigma", "regions", "profile")))
    found = {}
    for index, sigma in sigmas.items():
        worse = max(1.0, sharper * sigma / max(largest.sigma, MIN_SIGMA))
        was = known.get(index) or Errors(sharper * sigma, worse * largest.regions, worse * largest.profile)
        found[index] = replace(was, sigma=sharper * sigma)
    return found
