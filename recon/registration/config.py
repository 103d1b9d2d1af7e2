"""The configuration of registration: the lenses, and the mapper."""

from __future__ import annotations

import msgspec

from splatnode.recon.registration import lenses, mapper


class RegistrationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    lenses: lenses.LensGroupingConfig = lenses.LensGroupingConfig()
    mapper: mapper.MapperConfig = mapper.MapperConfig()
    # Given poses hold the cameras within their sigmas, where lenses are told; images that contradict one let it go.
    # --poses-sigma sets it. Otherwise given poses are compared with the cameras that the images tell
    trust_poses: bool = False
