"""The limits of the verdict. Those without a measurement behind them say so."""

from __future__ import annotations

import msgspec

from splatnode.capture.process.config import Internal


class DecisionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Before registration: frames and their pairs.
    min_cameras: Internal[int] = 2  # fewest cameras of a scene
    min_features: Internal[int] = 150  # fewest features of a frame that has enough texture
    # Median motion of a pair's matches below which the camera stood still, pixels at REFERENCE_SIDE
    static_px: Internal[float] = 1.0
    turned_share: Internal[float] = 0.8  # share of the pairs without parallax, from which on the camera has only turned
    # Of log focal, between a given one and the pairs' vote: so much explains why nothing could be placed
    voted_change: Internal[float] = 0.15

    # After registration: limits that decide by themselves.

    # That must hold two parts together; mirror images share 3, the loosest right answer 62
    min_link_points: Internal[int] = 20
    # Fewest points of a camera that two others see, too; 13 of 876 right answers have fewer, and 18 of 97 wrong ones
    min_confirmed: Internal[int] = 15
    # Gain of a group of frames when mirrored; right answers reach 0.25, mirrored frames 1
    max_reflection: Internal[float] = 0.4
    # Least cost of the scene mirrored in depth over its own; of 1175 registrations one was below 1.3, and wrong
    min_mirrored_cost: Internal[float] = 1.1
    # A flat thing that moves: facades, and meadows from afar, have 98 % of their points on one plane; a bare facade's
    # poses explain 85 % of its matches, those of a flat thing that moves 81 %.

    # Share of the points on one plane from which on it may be a flat thing that moves
    moving_flatness: Internal[float] = 0.99
    moving_inlier_ratio: Internal[float] = 0.845  # share of such a scene's matches that its poses must explain
    # Bounds beyond which nothing is known that a robot could use, and a scene is refused.
    max_rotation_deg: Internal[float] = 10.0  # largest 95 % bound of a camera's rotation
    # Largest 95 % bound of a camera's position, of the distance to the scene
    max_centre_percent: Internal[float] = 15.0
    max_travel_percent: Internal[float] = 50.0  # the same, of how far the camera moved: beyond, its depth is a guess
    # Bounds within which a scene is exact, which are those of a right answer; beyond, it is rough and says so.
    exact_rotation_deg: Internal[float] = 2.0  # largest bound of a camera's rotation for the verdict OK
    # Largest bound of a camera's position for it, of how far the camera moved
    exact_travel_percent: Internal[float] = 5.0
    # Largest bound of the focal length for it, by which the distance is uncertain, too
    exact_focal_percent: Internal[float] = 10.0
    # Largest bound of a position that the user accepts, of the distance to the scene; None: any
    max_position_error_percent: float | None = None
    # Least log-odds that published poses are right: 0 is more likely right than not, after all bounds
    min_log_odds: Internal[float] = 0.0

    # Given lenses: doubted when freeing them lowers the cost to `focal_gain` and changes them by more than this.

    # Largest cost with the lens free, over that with it held, which casts doubt on it
    focal_gain: Internal[float] = 0.8
    focal_change: Internal[float] = 0.04  # least change of log focal that does so, for a calibrated lens
    nominal_change: Internal[float] = 0.15  # least change of log focal for a nominal lens, as from EXIF
    held_back: Internal[float] = 0.03  # and by how much its prior held log focal back
    # Least shift of a picture's corner by further distortion, relative to its distance from the middle
    corner_shift: Internal[float] = 0.03

    # What explains poses that are unlikely.
    blurred_px: Internal[float] = 5.0  # width of edges, at 640 pixels, that explains why frames do not fit
    # Share of all matches that a pure rotation explains; chosen, not measured
    explained_by_turning: Internal[float] = 0.6
    explained_by_plane: Internal[float] = 0.85  # share of all matches that one plane explains; chosen, not measured
    exposure_ratio: Internal[float] = 1.6  # of the brightest to the darkest exposure, from which on the report notes it
