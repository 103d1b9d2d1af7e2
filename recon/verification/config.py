"""The limits of the verdict. Those without a measurement behind them say so."""

from __future__ import annotations

import msgspec


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Before registration: frames and their pairs.
    min_cameras: int = 2  # of a scene
    min_features: int = 150  # of a frame; those with fewer show too little texture
    static_px: float = 1.0  # median motion of a pair's matches at REFERENCE_SIDE; below it the camera stood still
    turned_share: float = 0.8  # of the pairs without parallax, from which on the camera has only turned
    voted_change: float = 0.15  # of log focal, between a given one and the pairs' vote, where nothing could be placed

    # After registration: limits that decide by themselves.
    min_link_points: int = 20  # that hold two parts together; mirror images share 3, the loosest right answer 62
    max_reflection: float = 0.4  # gain of a group of frames when mirrored; right answers reach 0.25, mirrored frames 1
    # A flat thing that moves: facades, and meadows from afar, have 98 % of their points on one plane; a bare facade's
    # poses explain 85 % of its matches, those of a flat thing that moves 81 %.
    moving_flatness: float = 0.99
    moving_inlier_ratio: float = 0.845
    # Bounds beyond which nothing is known that a robot could use, and a scene is refused.
    max_rotation_deg: float = 10.0
    max_centre_percent: float = 15.0  # of the distance to the scene
    max_travel_percent: float = 50.0  # of how far the camera moved: beyond, its depth is a guess
    # Bounds within which a scene is exact, which are those of a right answer; beyond, it is rough and says so.
    exact_rotation_deg: float = 2.0
    exact_travel_percent: float = 5.0
    exact_focal_percent: float = 10.0  # which the distance to the scene is uncertain by, too
    require_percent: float | None = None  # a centre's bound, of the distance to the scene, that the user needs
    min_log_odds: float = 0.0  # of poses that are published: more likely right than not, after all bounds

    # Given lenses: doubted when freeing them lowers the cost to `focal_gain` and changes them by more than this.
    focal_gain: float = 0.8  # cost with the lens free over the cost with it held
    focal_change: float = 0.04  # of log focal, for a calibrated lens
    nominal_change: float = 0.15  # of log focal, for a nominal one, as from EXIF; and its prior held it back
    held_back: float = 0.03  # by more than this, of log focal
    corner_shift: float = 0.03  # of a picture's corner by further distortion, relative to its distance from the middle

    # What explains poses that are unlikely.
    blurred_px: float = 5.0  # width of edges, at 640 px, that explains why frames do not fit
    explained_by_turning: float = 0.6  # share of all matches that a pure rotation explains; chosen, not measured
    explained_by_plane: float = 0.85  # share of all matches that one plane explains; chosen, not measured
    exposure_ratio: float = 1.6  # between the brightest and the darkest exposure, worth a note
