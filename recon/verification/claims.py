"""What is claimed of verified cameras: 95 % bounds of their errors, from what the evidence says of their size.

A bound is a product of powers (a line between logarithms) of what three sources say (errors.py), and of the share of a
camera's matches that its pose explains: each source sees what another is blind to, none is in the unit of a standard
error, and errors of real cameras grow more slowly than any of them. The number of cameras counts, too: the more there
are, the more each source takes errors for independent that are not. `fitted.py` has the powers, which
`python -m tests.bench fit` finds from registrations of real photographs with known cameras.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from splatnode.recon.result.bounds import Array, Bounds, compute_axes, make_ball
from splatnode.recon.verification.errors import Errors
from splatnode.recon.verification.evidence import Evidence

MIN_INLIER_RATIO = 0.05  # a camera with fewer counts as this: a logarithm is taken
# At least so many times what the focal length leaves open within one standard error: two standard errors.
OF_PROFILE = 2.0
# At least so many standard errors of the bundle adjustment, in which each image's lens may differ a little from the
# common one. Of the first 240 sets that break what is assumed of lenses 14 were beyond their claim, and 25 with 1
OF_SIGMA = 2.5


MAX_LOG_FOCAL = math.log(10.0)  # a factor of ten: who knows the focal length no better knows nothing


@dataclass(frozen=True)
class BoundModel:
    """The powers of one kind of bound, and what is added (in quadrature) to each source before it counts."""

    factor: float
    floor: float
    sigma: float
    regions: float
    profile: float
    inlier_ratio: float
    link: float  # of the share of matches explained across the weakest link: parts may lean against each other
    count: float  # of the number of cameras
    own_lens: float = 1.0  # times, where an image has a lens of its own: which images have one is not certain

    def predict_bound(
        self, errors: Errors, count: int, inlier_ratio: float = 1.0, link: float = 1.0, own_lens: bool = False
    ) -> float:
        """The bound in the unit of `errors`: never less than a source says. NaN and infinity stay what they are."""
        sources = {"sigma": errors.sigma, "regions": errors.regions, "profile": errors.profile}
        product = self.factor * count**self.count * (self.own_lens if own_lens else 1.0)
        product *= max(inlier_ratio, MIN_INLIER_RATIO) ** self.inlier_ratio * max(link, MIN_INLIER_RATIO) ** self.link
        for name, value in sources.items():
            product *= math.hypot(value, self.floor) ** getattr(self, name)
        parts = (product, OF_SIGMA * errors.sigma, errors.regions, OF_PROFILE * errors.profile)
        return math.nan if any(math.isnan(part) for part in parts) else max(parts)


@dataclass(frozen=True)
class ErrorModel:
    """The models of the bounds. A length counts in the distance to the scene, a focal length in its logarithm."""

    rotation: BoundModel  # degrees
    centre: BoundModel
    focal: BoundModel


def predict_bounds(evidence: Evidence, model: ErrorModel) -> dict[str, Bounds]:
    """The bounds of each camera, by its name, with balls for ellipsoids; the distance to the scene is 1."""
    count, link = len(evidence.cameras), evidence.weakest_link.inlier_ratio
    own, found = any(camera.own_lens for camera in evidence.cameras), {}
    for camera in evidence.cameras:
        focal = model.focal.predict_bound(camera.focal, count, own_lens=own)
        centre = model.centre.predict_bound(camera.errors.centre, count, camera.inlier_ratio, link, own)
        found[camera.name] = Bounds(
            rotation_deg=model.rotation.predict_bound(camera.errors.rotation, count, camera.inlier_ratio, link, own),
            centre=centre,
            centre_percent=100.0 * centre,
            focal_percent=100.0 * math.expm1(min(focal, MAX_LOG_FOCAL)),
            axes=make_ball(centre),
        )
    return found


def shape_bounds(bounds: Mapping[str, Bounds], covariances: Mapping[str, Array]) -> dict[str, Bounds]:
    """The bounds with ellipsoids of the shape of each centre's covariance (3, 3), by the cameras' names."""
    return {name: replace(each, axes=compute_axes(covariances[name], each.centre)) for name, each in bounds.items()}


def compute_travel_percent(bounds: Mapping[str, Bounds], evidence: Evidence) -> float:
    """How far off a centre may be, in percent of how far the camera moved: of the RMS distance from their mean."""
    farthest = max((each.centre for each in bounds.values()), default=math.nan)
    return 100.0 * farthest / evidence.travel if evidence.travel > 0 else math.inf
