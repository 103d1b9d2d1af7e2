"""The mutants, room by room in the order of the data: (what is wrong then, what stands there, what is put there)."""

from __future__ import annotations

from collections.abc import Iterator

from tests.mutants.mutant import Mutant


def _list_mutants(room: str, file: str, *faults: tuple[str, str, str]) -> Iterator[Mutant]:
    for name, find, replace in faults:
        yield Mutant(room, name, file, find, replace)


MUTANTS = (
    *_list_mutants(
        "capture",
        "capture/keyframe_selection.py",
        (
            "a corner that left the image counts as tracked",
            "tracked = (found[:, 0] == 1) & (returned[:, 0] == 1) & consistent & inside",
            "tracked = (found[:, 0] == 1) & (returned[:, 0] == 1) & consistent",
        ),
        (
            "waiting keyframes make the selection less strict",
            "strictness=1 + waiting / self.config.backlog",
            "strictness=1 / (1 + waiting / self.config.backlog)",
        ),
    ),
    *_list_mutants(
        "capture",
        "capture/image_header.py",
        ("the time zone's sign is lost", 'return -offset if sign == "-" else offset', "return offset"),
        (
            "the equivalent focal length compares widths",
            "return focal_mm * math.hypot(width, height) / _FILM_DIAGONAL_MM if focal_mm else None",
            "return focal_mm * max(width, height) / 36.0 if focal_mm else None",
        ),
    ),
    *_list_mutants(
        "capture",
        "extras/logged/messages.py",
        ("OpenCV's principal point is half a pixel off", "cx - x + 0.5, cy - y + 0.5,", "cx - x, cy - y,"),
    ),
    *_list_mutants(
        "capture",
        "capture/pose_files.py",
        (
            "poses in TUM's order of the quaternion are mixed up",
            "numbers.extend((x, y, z, qw, qx, qy, qz))",
            "numbers.extend((x, y, z, qx, qy, qz, qw))",
        ),
    ),
    *_list_mutants(
        "capture",
        "capture/keyframe_selection.py",
        (
            "blur is measured in one direction",
            "return max((width for width in widths if width is not None), default=None)",
            "return min((width for width in widths if width is not None), default=None)",
        ),
    ),
    *_list_mutants(
        "messaging",
        "capture/messaging/messages.py",
        (
            "an array without elements may promise anything",
            "math.prod(max(1, side) for side in shape)",
            "math.prod(shape)",
        ),
        (
            "a large header is decoded",
            "if total_bytes > limits.total_bytes or buffers[1].nbytes > limits.header_bytes:",
            "if total_bytes > limits.total_bytes:",
        ),
        (
            "numbers of a stranger's header are not checked",
            "    if not limits.own:\n        check(envelope.header)\n",
            "",
        ),
    ),
    *_list_mutants(
        "messaging",
        "capture/messaging/pubsub.py",
        (
            "an older state of the same session is taken",
            "if header.session == self._session and header.sequence <= self._sequence:",
            "if header.session == self._session and header.sequence < self._sequence - 1:",
        ),
        (
            "one lost message more is counted",
            "self.lost += header.sequence - self._sequence - 1",
            "self.lost += header.sequence - self._sequence",
        ),
    ),
    *_list_mutants(
        "messaging",
        "capture/messaging/keyframe_queue.py",
        (
            "answers of a recon that is not served count",
            "        if not self._turns.is_active(identity):\n            self.ignored += 1\n            return\n",
            "",
        ),
        (
            "a second recon takes over at once",
            "if now_s - served.heard_s > SILENT_S or served.process == asking.process:",
            "if now_s - served.heard_s >= 0.0 or served.process == asking.process:",
        ),
    ),
    *_list_mutants(
        "spool",
        "capture/messaging/keyframe_queue.py",
        (
            "a damaged message is not noticed",
            "if magic != _MAGIC or len(body) != size or zlib.crc32(body) != checksum:",
            "if magic != _MAGIC or len(body) != size:",
        ),
        (
            "the bound on size is not kept",
            "if len(self) >= self.config.max_frames or self.size_bytes + size > self.config.max_mb << 20:",
            "if len(self) >= self.config.max_frames:",
        ),
        (
            "one keyframe more than the bound",
            "if len(self) >= self.config.max_frames or",
            "if len(self) > self.config.max_frames or",
        ),
        (
            "numbers begin anew after a restart",
            "self._number = max((_number(path) for path in found), default=-1) + 1",
            "self._number = 0",
        ),
        (
            "the quarantine gives the newest up",
            "oldest = next(iter(self._records))",
            "oldest = next(reversed(self._records))",
        ),
    ),
    *_list_mutants(
        "matching",
        "recon/matching/features.py",
        (
            "features are half a pixel to the upper left",
            "return (points.astype(np.float64) + 0.5) * (width / size[0], height / size[1]), descriptors",
            "return points.astype(np.float64) * (width / size[0], height / size[1]), descriptors",
        ),
    ),
    *_list_mutants(
        "matching",
        "recon/matching/pair_matching.py",
        (
            "the number of false alarms counts no choice of a sample",
            "        + log10_choose(num_inliers, sample_size)\n",
            "",
        ),
        (
            "a swapped pair keeps the order of its points",
            "points1=self.points2, points2=self.points1)",
            "points1=self.points1, points2=self.points2)",
        ),
    ),
    *_list_mutants(
        "matching",
        "recon/matching/pair_matching.py",
        (
            "a point keeps its least distinct match",
            'merged = np.concatenate(found)[np.argsort(rank, kind="stable")]',
            'merged = np.concatenate(found)[np.argsort(-rank, kind="stable")]',
        ),
    ),
    *_list_mutants(
        "matching",
        "recon/matching/pair_matching.py",
        (
            "the smallest component comes first",
            "key=lambda group: (-len(group), group)",
            "key=lambda group: (len(group), group)",
        ),
    ),
    *_list_mutants(
        "registration",
        "recon/registration/bundle_adjustment.py",
        (
            "a point behind a camera has a finite error",
            "return np.where(depth > 0, np.linalg.norm(predicted - problem.pixels, axis=1), np.inf)",
            "return np.linalg.norm(predicted - problem.pixels, axis=1)",
        ),
        (
            "the centres of a pair are turned until they fit",
            "    if count < MIN_FOR_CENTRES:",
            "    if count < 0:",
        ),
        (
            "centres are R t instead of -R^T t",
            'return -np.einsum("cji,cj->ci", problem.rotations, problem.translations)',
            'return -np.einsum("cij,cj->ci", problem.rotations, problem.translations)',
        ),
        (
            "a negative variance counts as none",
            "return np.where(known, np.sqrt(np.where(known, variances, 0.0)), np.inf)",
            "return np.where(known, np.sqrt(np.where(known, variances, 0.0)), 0.0)",
        ),
    ),
    *_list_mutants(
        "registration",
        "recon/registration/mapping_problem.py",
        (
            "windows that match the windows beside them make tracks",
            "if len(other) >= _MIN_COMPARED and _MIN_REPEATED <= other.mean() <= _MAX_REPEATED:",
            "if len(other) < 0:",
        ),
        (
            "a thing before a far wall passes for a repeated window",
            "return is_alone & ~(agree & same_feature).any(1)",
            "return is_alone",
        ),
    ),
    *_list_mutants(
        "registration",
        "recon/registration/multiview_geometry.py",
        ("points of a tenth of a degree are kept", "min_angle_deg: float = 1.0", "min_angle_deg: float = 0.1"),
        ("a frame's two features of one track both stay", "unique = count[group] == 1", "unique = count[group] >= 1"),
    ),
    *_list_mutants(
        "registration",
        "recon/geometry.py",
        (
            "the similarity may mirror",
            "signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])",
            "signs = np.array([1.0, 1.0, 1.0])",
        ),
    ),
    *_list_mutants(
        "verification",
        "recon/locating/pose_refinement.py",
        ("landmarks are looked for where their camera leaves them open", "_REACH_SIGMAS = 2.0", "_REACH_SIGMAS = 0.0"),
    ),
    *_list_mutants(
        "verification",
        "recon/locating/verification.py",
        ("a vague start is kept", "_VAGUE = 0.03", "_VAGUE = 9.0"),
    ),
    *_list_mutants(
        "verification",
        "recon/verification/decision.py",
        ("undetermined numbers are not asked for", "    check_finite,\n    *LIMITS", "    *LIMITS"),
        ("a strongly bent lens is not asked for", "    check_strong_distortion,\n", ""),
        ("a montage of two is a scene", "    check_montage,\n", ""),
        ("one small flat thing is enough for a camera", "    check_flat_patch,\n", ""),
        (
            "the odds are asked the wrong way round",
            "if found.total >= case.config.min_log_odds:",
            "if found.total <= case.config.min_log_odds:",
        ),
        (
            "most images must refute a given lens, half will do",
            "if 2 * len(refuted) <= len(changes):",
            "if 2 * len(refuted) < len(changes):",
        ),
    ),
    *_list_mutants(
        "verification",
        "recon/verification/error_model.py",
        ("a bound may be below the standard error", "OF_SIGMA = 2.5", "OF_SIGMA = 0.0"),
        (
            "NaN in a bound is dropped",
            "return math.nan if any(math.isnan(part) for part in parts) else max(parts)",
            "return max((part for part in parts if not math.isnan(part)), default=0.0)",
        ),
    ),
    *_list_mutants(
        "depth",
        "recon/priors/__init__.py",
        (
            "world points are half a pixel off",
            "    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)\n    rays",
            "    u, v = np.meshgrid(np.arange(width), np.arange(height))\n    rays",
        ),
        (
            "normals of a depth map face away",
            "return np.where(away, -normal, normal).astype(np.float32)",
            "return np.where(away, normal, -normal).astype(np.float32)",
        ),
        ("depths that differ by 20 % count as consistent", "AGREEING = 0.02", "AGREEING = 0.2"),
    ),
    *_list_mutants(
        "depth",
        "recon/priors/stereo.py",
        (
            "confidence grows with views that look through",
            "per_conflicting: float = -0.67",
            "per_conflicting: float = 0.67",
        ),
        ("normals face away from the camera", "return -away / length[..., None]", "return away / length[..., None]"),
    ),
    *_list_mutants(
        "depth",
        "recon/core/patchmatch_check.cpp",
        (
            "core: a view that hides a point counts as looking through it",
            "if (there.z * seen_w < (1 - 3 * tolerance.relative_depth) * w) ++conflicting;",
            "if (there.z * seen_w > (1 + 3 * tolerance.relative_depth) * w) ++conflicting;",
        ),
    ),
    *_list_mutants(
        "scene",
        "recon/scene/initialization.py",
        (
            "equation 14: best confidence instead of the mean",
            "float(pointmap.confidence.mean())",
            "float(pointmap.confidence.max())",
        ),
        ("equations 15 to 17: only the last more confident view masks", "mask |= near &", "mask = near &"),
        (
            "equation 16: the tolerance is no part of the depth",
            "near = np.abs(projected - target.depth) < config.depth_tolerance * target.depth",
            "near = np.abs(projected - target.depth) < config.depth_tolerance",
        ),
        (
            "equation 15: the less confident view masks",
            "if (score[i], -i) > (score[j], -j):",
            "if (score[i], -i) < (score[j], -j):",
        ),
    ),
    *_list_mutants(
        "losses",
        "recon/optimize/losses/depth.py",
        ("depth loss on no pseudo view", "        on_pseudo_view=against(supervision.pseudo_surfaces),\n", ""),
        (
            "depth loss on pseudo views against training views",
            "on_pseudo_view=against(supervision.pseudo_surfaces)",
            "on_pseudo_view=against(supervision.surfaces)",
        ),
    ),
    *_list_mutants(
        "losses",
        "recon/optimize/losses/normal.py",
        ("normal loss on no pseudo view", "        on_pseudo_view=against(supervision.pseudo_surfaces),\n", ""),
    ),
    *_list_mutants(
        "losses",
        "recon/optimize/regularizers.py",
        (
            "semantic loss against the farthest view",
            "nearest = start if share < 0.5 else end",
            "nearest = end if share < 0.5 else start",
        ),
    ),
    *_list_mutants(
        "losses",
        "recon/optimize/losses/semantic.py",
        (
            "semantic loss: embeddings not of unit length",
            "return functional.normalize(tokens[0, 0], dim=0)",
            "return tokens[0, 0]",
        ),
    ),
    *_list_mutants(
        "losses",
        "recon/optimize/losses/point_render.py",
        (
            "point-render loss without its seen pixels",
            "rgb = render.rgb if config.compare_unseen else torch.where(seen[index], render.rgb, 1.0)",
            "rgb = torch.where(seen[index], render.rgb, 1.0) if config.compare_unseen else render.rgb",
        ),
    ),
    *_list_mutants(
        "losses",
        "recon/optimize/photometric_losses.py",
        ("photometric loss: an SSIM constant of .01", "C1, C2 = 0.01**2, 0.03**2", "C1, C2 = 0.01**2, 0.01**2"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/methods.py",
        (
            "paper: point render ends at 1.0 instead of .8",
            "point_render.Config(0.25, 0.1, 0.8,",
            "point_render.Config(0.25, 0.1, 1.0,",
        ),
        ("paper: depth ends at .9 instead of .7", "depth.Config(0.05, 0.2, 0.7)", "depth.Config(0.05, 0.2, 0.9)"),
        (
            "paper: normal from 0 to 1 instead of .2 to .7",
            "normal.Config(0.01, 0.2, 0.7)",
            "normal.Config(0.01, 0.0, 1.0)",
        ),
        ("paper: semantic from .5 instead of .1", "semantic.Config(0.5, 0.1, 0.8)", "semantic.Config(0.5, 0.5, 0.8)"),
        ("paper: white where no point is, not compared", "compare_unseen=True", "compare_unseen=False"),
        ("InstantSplat: colours a tenth as fast", "sh=2.5e-2,", "sh=2.5e-3,"),
        ("InstantSplat: D-SSIM .8 instead of .2", "ssim_lambda=0.2,", "ssim_lambda=0.8,"),
        ("InstantSplat: steps of poses do not fall", "final_pose=0.01,", "final_pose=1.0,"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/methods.py",
        ("a rival's model of two cameras is published", "MIN_CAMERAS = 3", "MIN_CAMERAS = 2"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/rivals/colmap.py",
        (
            "COLMAP: each photograph its own camera",
            "one_camera = pycolmap.CameraMode.PER_FOLDER",
            "one_camera = pycolmap.CameraMode.PER_IMAGE",
        ),
        ("COLMAP: the smallest model is taken", "largest = max(solid,", "largest = min(solid,"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/rivals/colmap_3dgs.py",
        ("3DGS: Gaussians of a third of the opacity", "_OPACITY = 0.1", "_OPACITY = 0.03"),
        ("3DGS: scales a tenth as fast", "log_scales=5e-3,", "log_scales=5e-4,"),
        (
            "3DGS published: the steps fall as in the longer run",
            "final_means=RATES.final_means**_SHORTER",
            "final_means=RATES.final_means",
        ),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/rivals/colmap_fsgs.py",
        ("FSGS: the threshold of 3DGS", "min_gradient=5e-4", "min_gradient=2e-4"),
    ),
    *_list_mutants(
        "recipes",
        "recon/optimize/control/proximity.py",
        ("FSGS: one neighbour instead of three", "neighbours: Internal[int] = 3", "neighbours: int = 1"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/rivals/cf_3dgs.py",
        ("CF-3DGS: a twentieth of the steps to the next pose", "motion: int = 200", "motion: int = 10"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/rivals/nerfmm.py",
        ("NeRF--: the focal length starts at half the image", "Focal(1.0)", "Focal(0.5)"),
    ),
    *_list_mutants(
        "recipes",
        "extras/evaluate/rivals/nope_nerf.py",
        (
            "NoPe-NeRF: depth counts a tenth",
            "_DEPTH, _CLOUD, _SURFACE = 0.04, 1.0, 1.0",
            "_DEPTH, _CLOUD, _SURFACE = 0.004, 1.0, 1.0",
        ),
        ("NoPe-NeRF: pairs count to the end", "_PAIRS_UNTIL = 0.6", "_PAIRS_UNTIL = 1.0"),
    ),
    *_list_mutants(
        "scoring",
        "extras/evaluate/protocol.py",
        ("the interpolated start is the true pose", 'if settings.start == "interpolated":', "if False:"),
        (
            "test pose: the last, not the best",
            "if level == levels - 1 and loss < best_loss:",
            "if level == levels - 1:",
        ),
        (
            "held out: the rim counts",
            "shown = keyframes.valid_rectangle(valid)",
            "shown = (slice(0, valid.shape[0]), slice(0, valid.shape[1]))",
        ),
        (
            "the light of a vignetting lens is not put on renders",
            "with_rim = light * appearance.render(",
            "with_rim = appearance.render(",
        ),
        (
            "PSNR of absolute differences",
            "squares = (image.double() - truth.double()) ** 2",
            "squares = (image.double() - truth.double()).abs()",
        ),
        (
            "a scene's means leave out what scored nothing",
            "measured = [value for value in values if value is not None]",
            "measured = [value for value in values if value]",
        ),
        (
            "what a mask hides counts as the photograph shows it",
            "whole = torch.where(used[..., None], whole, with_rim)",
            "whole = whole + 0.0",
        ),
    ),
    *_list_mutants(
        "scoring",
        "extras/evaluate/stability/trial.py",
        (
            "claim: right is within 5 degrees",
            "RIGHT_ROTATION_DEG, RIGHT_SPREAD_PCT = 2.0, 5.0",
            "RIGHT_ROTATION_DEG, RIGHT_SPREAD_PCT = 5.0, 5.0",
        ),
        ("claim: wrong beyond 4 times a bound", "BOUNDS_WIDENED = 2.5", "BOUNDS_WIDENED = 4.0"),
        (
            "a wrong scene that is published is right where either answer fits",
            "return Outcome.ACCEPTED if published_right else Outcome.FALSE_ACCEPT",
            "return Outcome.ACCEPTED if published_right or demand is Demand.EITHER else Outcome.FALSE_ACCEPT",
        ),
    ),
    *_list_mutants(
        "scoring",
        "recon/networks/lpips.py",
        (
            "LPIPS without its shift of colours",
            "_SHIFT, _SCALE = (-0.030, -0.088, -0.188)",
            "_SHIFT, _SCALE = (0.0, 0.0, 0.0)",
        ),
    ),
    *_list_mutants(
        "scoring",
        "extras/evaluate/regions.py",
        ("regions: seen once counts as seen twice", '"two": (2,)', '"two": (1, 2)'),
    ),
    *_list_mutants(
        "scoring",
        "extras/evaluate/protocol.py",
        (
            "centre error is the largest and not the root mean square",
            "math.sqrt(float(((moved - target) ** 2).sum(1).mean()))",
            "math.sqrt(float(((moved - target) ** 2).sum(1).max()))",
        ),
    ),
    *_list_mutants(
        "scoring",
        "extras/evaluate/stability/windows.py",
        (
            "windows: wrong cameras of a rough answer do not count",
            "if not self.cameras or any(camera.is_wrong(self.verdict == ROUGH) for camera in self.cameras):",
            "if not self.cameras or any(camera.is_wrong(True) for camera in self.cameras):",
        ),
    ),
    *_list_mutants(
        "scoring",
        "extras/evaluate/stability/window_campaign.py",
        (
            "windows: the coverage counts refused cameras",
            "cameras = [camera for row in rows if row.published for camera in row.cameras]",
            "cameras = [camera for row in rows for camera in row.cameras]",
        ),
    ),
    *_list_mutants(
        "fit",
        "extras/evaluate/stability/fitting.py",
        (
            "leave-one-scene-out leaves nothing out",
            "fit_models([sample for sample in samples if sample.scene != scene])",
            "fit_models(samples)",
        ),
        (
            "the prior is not by scenes that were left out",
            "rest = (scenes != scene) & ~broken",
            "rest = (scenes == scenes) & ~broken",
        ),
        (
            "rejudged: the product's verdict stands",
            "return [_rejudge_row(row, make_window_sample(row), numbers) if row.evidence is not None",
            "return [row if row.evidence is not None",
        ),
        (
            "rejudged: what was refused stays refused",
            "return replace(row, published=True, verdict=verdict, cameras=cameras)",
            "return replace(row, published=row.published, verdict=verdict, cameras=cameras)",
        ),
        ("rejudged: rough cameras count as exact", "if exact else ROUGH", "if exact or True else ROUGH"),
        ("no margin", "MARGIN = 0.5", "MARGIN = 0.0"),
        ("quantile of .90", "QUANTILE = 0.96", "QUANTILE = 0.90"),
        (
            "bounds are fitted to gross errors, too",
            "if not sample.is_gross and (sample.own_lens or not sample.broken)]",
            "if sample.own_lens or not sample.broken]",
        ),
        ("a wrong registration weighs as much as a right one", "WRONG_WEIGHT = 4.0", "WRONG_WEIGHT = 1.0"),
        (
            "the report counts windows with a told lens among the others",
            "windows = [pair for pair in pairs if pair[0].window and not pair[0].has_known_lens]",
            "windows = [pair for pair in pairs if pair[0].window]",
        ),
    ),
    *_list_mutants(
        "fit",
        "extras/evaluate/stability/fitting.py",
        (
            "cameras of two worlds are no gross error",
            "return not self.is_one_world or any(\n            error.centre_pct",
            "return any(\n            error.centre_pct",
        ),
    ),
    *_list_mutants(
        "node",
        "recon/daemon/submap.py",
        ("the newest keyframes may be given up", "old = len(graph.keyframes) - NEWEST", "old = len(graph.keyframes)"),
        (
            "a merged scene may lose most cameras",
            "if placed and len(placed & standing) >= MIN_KEPT_CAMERAS * len(standing):",
            "if placed:",
        ),
    ),
    *_list_mutants(
        "node",
        "recon/daemon/checkpoint.py",
        (
            "a frame that was removed may come again",
            "gone=(*ledger.gone, *keys)[-REMEMBERED:],",
            "gone=ledger.gone[-REMEMBERED:],",
        ),
        (
            "a part of a frame set stays after a kill",
            "if last is None or not last.following or self._next > last.number + 1:",
            "if last is None or last.following or self._next > last.number + 1:",
        ),
        (
            "a new frame may get the name of one that is there",
            "taken = {*self._names, *others, *(dropped for dropped, _ in self.ledger.dropped)}",
            "taken = {*others, *(dropped for dropped, _ in self.ledger.dropped)}",
        ),
    ),
    *_list_mutants(
        "node",
        "recon/daemon/pose_graph.py",
        ("a contradicted loop stays", "CONTRADICTED = 5.0", "CONTRADICTED = 1e6"),
        (
            "links are followed the wrong way",
            "reached.setdefault(each.scene, found[each.other].after(each.similarity.inverse()))",
            "reached.setdefault(each.scene, found[each.other].after(each.similarity))",
        ),
    ),
    *_list_mutants(
        "node",
        "recon/daemon/free_space.py",
        ("a map of a lost robot is told", "        if state is ReconState.LOST:\n            return LOST\n", ""),
    ),
    *_list_mutants(
        "viewer",
        "viewer/state.py",
        (
            "an orbit to the right goes left",
            "turned = _rotation(view.up, right_rad) @ outwards",
            "turned = _rotation(view.up, -right_rad) @ outwards",
        ),
        (
            "an orbit goes over the pole",
            "raised = float(np.clip(elevation + up_rad, -_STEEPEST, _STEEPEST))",
            "raised = float(elevation + up_rad)",
        ),
        (
            "a drag moves the scene the wrong way",
            "T[:3, 3] -= view.distance / focal_px",
            "T[:3, 3] += view.distance / focal_px",
        ),
        (
            "zoom moves the pivot",
            "T[:3, 3] = view.pivot - distance * T[:3, 2]",
            "T[:3, 3] = view.pivot - view.distance * T[:3, 2]",
        ),
    ),
    *_list_mutants(
        "viewer",
        "viewer/analysis.py",
        ("a hidden Gaussian counts as seen", "_BEHIND = 1.05", "_BEHIND = 100.0"),
    ),
    *_list_mutants(
        "viewer",
        "viewer/analysis.py",
        (
            "advice takes points that are turned away for seen",
            "return ahead & facing & (pixels >= 0).all(1)",
            "return ahead & (pixels >= 0).all(1)",
        ),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/formats/nerfstudio.py",
        (
            "nerfstudio gets OpenCV's axes",
            "_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])",
            "_OPENCV_FROM_OPENGL = np.diag([1.0, 1.0, 1.0, 1.0])",
        ),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/formats/colmap.py",
        (
            "COLMAP gets camera-to-world",
            "_format_motion(np.asarray(np.linalg.inv(T_world_camera), np.float64))",
            "_format_motion(np.asarray(T_world_camera, np.float64))",
        ),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/formats/tum.py",
        (
            "TUM's quaternion begins with w",
            "return [*camera.T_world_camera[:3, 3], x, y, z, w]",
            "return [*camera.T_world_camera[:3, 3], w, x, y, z]",
        ),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/formats/ply.py",
        (
            "PLY has opacities in place of their logits",
            "rows[:, rest] = np.log(opacities) - np.log1p(-opacities)",
            "rows[:, rest] = opacities",
        ),
        (
            "PLY has harmonics colour by colour last",
            "gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(num_gaussians, rest - 9)",
            "gaussians.sh[:, 1:].reshape(num_gaussians, rest - 9)",
        ),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/formats/splat.py",
        (
            ".splat begins with the least visible",
            'np.argsort(-visible, kind="stable")',
            'np.argsort(visible, kind="stable")',
        ),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/formats/spz.py",
        (".spz keeps our axes", "_AXES = np.array([1, -1, -1], np.float32)", "_AXES = np.array([1, 1, 1], np.float32)"),
    ),
    *_list_mutants(
        "export",
        "recon/result/export/stored.py",
        (
            "two cameras of one name are read",
            "if len({camera.name for camera in cameras}) < len(cameras):",
            "if False:",
        ),
    ),
)
