"""docs/live.md: streams, walks, faults, batches and the viewer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tests.reference.measured.raw import part, percent, raw, require, span, table, thousands

STEPS = ("add", "update", "localize", "finalize", "map")
Row = tuple[str, str, str]  # what ran, what came of it, its raw file
HEADER = ("run", "result", "raw file")


def rates() -> str:
    """The seconds of each step of a scene that grows, by number of views."""
    found = raw("rates")
    require(found["command"] == "splatnode doctor --rates 3 6 12 24 --json", "measured by the command of the page")
    seconds = [[each[f"{step}_s"] for step in STEPS] for each in found["rates"]]
    rows = [
        (str(each["views"]), *("–" if took is None else f"{took:.2f} s" for took in times))
        for each, times in zip(found["rates"], seconds, strict=True)
    ]
    return table(("views", *STEPS), rows)


def live_scenes() -> str:
    """How soon scenes are shown, and what streams of real photographs come to."""
    return table(HEADER, [*_first_scenes(), *_streams(), *_revisits()])


def _first_scenes() -> Iterable[Row]:
    rows = raw("live")["rows"]
    require([row["scene"] for row in rows] == ["fox", "llff_flower", "tum_fr3_office"], "three sets")
    require(all(row["live_psnr"] == row["offline_psnr"] for row in rows), "final scenes are those of an offline run")
    first, further = (", ".join(f"{row[key]:.1f}" for row in rows) for key in ("first_scene_s", "further_s_p95"))
    yield (
        "fox, llff_flower, tum_fr3_office, a photograph every 2 s",
        f"first scene {first} s after the third keyframe; a further keyframe shown after {further} s (95th "
        "percentile); "
        "final scenes as offline, to the bit",
        "`live.json`",
    )


def _streams() -> Iterable[Row]:
    stream = raw("stream")
    require(stream["in_a_scene"] == stream["photographs"] == 40 and not stream["in_no_list"], "all in a scene")
    castle, fox = (place["psnr"] for place in stream["places"])
    offline = stream["offline"]
    require(abs(castle - offline["castle_p30"]["psnr"]) < 0.005, "castle as offline")
    yield (
        "40 photographs of castle_p30, then fox, one every 3 s",
        f"all in a scene; held out {castle:.1f} dB (castle, as offline), {fox:.1f} (fox, offline "
        f"{offline['fox']['psnr']:.1f}); {_delay(stream)}; {_finished(stream)}",
        "`stream.json`",
    )
    fast = raw("stream_fast")
    require(fast["in_a_scene"] == fast["photographs"] == 60 and len(fast["places"]) == 2, "all in two scenes")
    yield (
        "30 photographs of castle_p30, then 30 of fox, two a second",
        f"all in a scene; {_within(fast['cameras'].values())}; {_delay(fast)}; {_finished(fast)}; {_memory(fast)}",
        "`stream_fast.json`",
    )
    five = raw("stream_five")
    require((five["photographs"], five["in_a_scene"], len(five["in_no_list"])) == (74, 72, 2), "72 of 74")
    require([each["scenes"] for each in five["cameras"].values()] == [1] * 5 == [1] * len(five["places"]), "five")
    yield (
        "74 photographs of five places, one every 2 s",
        f"5 scenes, none joined; 72 in a scene, 2 left out as blurred; {_within(five['cameras'].values())}; "
        f"{_delay(five)}",
        "`stream_five.json`",
    )
    chain = raw("stream_chain")
    require(chain["in_a_scene"] == chain["photographs"] == 30 and len(chain["places"]) == 3, "30 in 3 scenes")
    castle = chain["cameras"]["castle_p30"]
    require(castle["linked"] == 3 and castle["cameras"] == 30, "three linked scenes")
    yield (
        "30 photographs of castle_p30, one every 3 s, `max_views: 12`",
        f"3 linked scenes; {_within([castle])}; {_delay(chain, 1)}",
        "`stream_chain.json`",
    )


def _revisits() -> Iterable[Row]:
    back = raw("stream_back")
    visits = back["visits"]
    require(back["photographs"] == back["in_a_scene"] == 72 and visits["joined"] == [], "72, none joined")
    yield (
        "72 photographs of four places, one a second: half there, half back",
        f"all in a scene; {len(visits['recognised'])} of {len(visits['found_there'])} places recognised, none joined "
        f"with another; {_within(back['cameras'][name] for name in visits['recognised'])}; {_finished(back)}; "
        f"{_memory(back)}",
        "`stream_back.json`",
    )
    every = raw("stream_all")
    visits, cameras = every["visits"], every["cameras"]
    require(len(cameras) == 17 and visits["joined"] == [["castle_p30", "entry_p10", "fountain_p11"]], "one courtyard")
    require(set(visits["recognised"]) < set(visits["found_there"]), "recognised are found")
    used = {name for place in every["places"] for name in place["frames_used"]}
    rejected, unlisted = len(every["left_out_by_name"].keys() - used), len(every["in_no_list"])
    require(every["in_a_scene"] + rejected + unlisted == every["photographs"], "each photograph is told")
    yield (
        f"{every['photographs']} photographs of all 17 real scenes, one every 2 s: half there, half back",
        f"{len(visits['found_there'])} of 17 places found, {len(visits['recognised'])} of these recognised; only "
        f"castle, entry and fountain joined, which are one courtyard; {every['in_a_scene']} in a scene, {rejected} "
        f"rejected with the reason, {unlisted} left out as blurred; "
        f"{_within(cameras[name] for name in visits['recognised'])}; {_delay(every)}; {_finished(every)}; "
        f"{_memory(every)}",
        "`stream_all.json`",
    )


def _within(cameras: Iterable[dict[str, Any]]) -> str:
    known = list(cameras)
    rotation, centre = (max(each[what] for each in known) for what in ("rotation_deg", "centre_pct"))
    return f"cameras within {rotation:.2f}°, {centre:.2f} %"


def _delay(run: dict[str, Any], digits: int = 0) -> str:
    return f"delay {run['delay_s_median']:.{digits}f} s, at most {run['delay_s_most']:.{digits}f}"


def _finished(run: dict[str, Any]) -> str:
    return f"final {run['all_finished_s'] - run['taken_s']:.0f} s after the last photograph"


def _memory(run: dict[str, Any]) -> str:
    return f"{run['recon_mb_most'] / 1e3:.2f} GB"


def walks() -> str:
    """Walks through the built-in building."""
    return table(HEADER, [*_walk_of_240(), *_walks_of_1000(), *_small_walks(), *_growing(), *_film()])


def _walk_of_240() -> Iterable[Row]:
    walk = raw("building")
    loops, cost = walk["loops"], walk["cost"]
    require(walk["in_a_scene"] == walk["keyframes"] and walk["all_finished_s"] is None, "all placed, cut off")
    require(loops["linked_or_in_one_map"] == loops["revisits"], "all revisits in one map")
    seconds, delay = cost["second"], cost["delay_s"]
    before = max(sample["rss_mb"] for sample in cost["samples"] if sample["done"] < walk["keyframes"]) / 1e3
    yield (
        f"{walk['keyframes']} keyframes, {walk['cameras']['path_m']:.0f} m, one every 2 s, `max_views: 20`",
        f"cut off 15 minutes after the walk, before the last scenes were final; all in {walk['scenes']} scenes; "
        f"{_along(walk)}; all {loops['revisits']} revisits in one map, {_loops(loops)}; {seconds['median']:.1f} s a "
        f"keyframe, 95th percentile {seconds['percentile_95']:.1f}; delay {delay['median']:.0f} s, at most "
        f"{delay['most']:.0f}; {cost['checkpoint_mb']['growth_per_keyframe']:.1f} MB of disk a keyframe; "
        f"{before:.2f} GB "
        f"on the way, {cost['rss_mb']['most'] / 1e3:.2f} GB at the end",
        "`building.json`",
    )


def _walks_of_1000() -> Iterable[Row]:
    walk = raw("building_1000")
    cost, loops = walk["cost"], walk["loops"]
    seconds, memory = cost["processor_s"], cost["rss_mb"]
    final = sum(not place["provisional"] for place in walk["places"])
    yield (
        f"{walk['keyframes']} keyframes, {walk['cameras']['path_m']:.0f} m",
        f"stopped 18 minutes after the walk, with {final} of {walk['scenes']} scenes final and most revisits not asked "
        f"yet; {walk['in_a_scene']} in a scene; {_along(walk)}; {_loops(loops)}; {seconds['median']:.1f} s of "
        "processor "
        f"a keyframe, 95th percentile {seconds['percentile_95']:.1f}, running median "
        f"{100 * seconds['slope_of_median_per_100']:.1f} % a hundred keyframes; "
        f"{walk['memory_on_the_way_mb'] / 1e3:.2f} GB on the way ({memory['growth_per_keyframe']:.2f} MB a keyframe), "
        f"{memory['most'] / 1e3:.2f} GB at the end; {cost['checkpoint_mb']['growth_per_keyframe']:.1f} MB of disk a "
        "keyframe",
        "`building_1000.json`",
    )
    judged = raw("building_1000_judged")
    loops = judged["loops"]
    require(judged["maps"] == 1 and loops["linked_or_in_one_map"] == loops["revisits"], "one map")
    yield (
        "the same walk, recon started again with newer code until all submaps were judged",
        f"one map of {judged['scenes']} scenes; {_along(judged, 4)}; all {loops['revisits']} revisits in it, "
        f"{loops['linked']} by a loop of their own; {_loops(loops)}; {loops['retracted']} more, of rooms that look "
        "alike, were accepted, then retracted",
        "`building_1000_judged.json`",
    )


def _small_walks() -> Iterable[Row]:
    walk = raw("building_120")
    cost, loops = walk["cost"], walk["loops"]
    require(walk["in_a_scene"] == walk["keyframes"] == 120, "all 120 placed")
    before = max(sample["rss_mb"] for sample in cost["samples"] if sample["done"] < walk["keyframes"]) / 1e3
    seconds = cost["processor_s"]
    yield (
        "120 keyframes, with less memory for the refinement, `max_views: 20`",
        f"all in {walk['scenes']} scenes; {_loops(loops)}; {before:.2f} GB on the way, "
        f"{cost['rss_mb']['most'] / 1e3:.2f} GB at the end; {seconds['median']:.1f} s of processor a keyframe, 95th "
        f"percentile {seconds['percentile_95']:.1f}",
        "`building_120.json`",
    )
    room = raw("building_50")["first_room"]
    alone = room["alone"]
    require(alone["psnr"] - room["psnr"] < 0.3, "the first room is as good as offline")
    yield (
        "first room of a walk of 50, 4 held-out photographs",
        f"{room['psnr']:.1f} dB with {room['gaussians']} Gaussians; offline {alone['psnr']:.1f} dB with "
        f"{alone['gaussians']}",
        "`building_50.json`",
    )


def _growing() -> Iterable[Row]:
    run = raw("growing")
    located, solid, after = run["located"], run["free_solid"], run["map_after_s"]
    require(located["placed"] == located["within_bounds"] == located["questions"], "all images are placed, in bounds")
    require(solid["provisional"] < 0.01, "the bar of 1 % is met while the scene grows")
    alone = run["alone_s"]
    require(alone["p95"] < 3.0, "the bar of 3 s is met by a machine without other work")
    yield (
        f"{run['keyframes']} keyframes of one room, one every {1 / run['per_second']:.0f} s, and two images a second",
        f"{alone['median']:.1f} s of a thread from a keyframe to its free space, 95th percentile {alone['p95']:.1f} s "
        f"(in this run {after['median']:.1f} and {after['p95']:.1f} s, with other work on both cores); at most "
        f"{percent(solid['provisional'], 2)} of the free space solid while the scene grew, "
        f"{percent(solid['final'], 2)} at the end (the bar is .1 %); all {located['placed']} images located within "
        f"their bounds, in {located['seconds']['median']:.1f} s, 95th percentile {located['seconds']['p95']:.1f} s",
        "`growing.json`",
    )


def _film() -> Iterable[Row]:
    film = raw("film")
    live, offline = film["live"], film["offline"]
    require(live["maps"] == offline["maps"] == 1, "one map either way")
    cells = [
        f"{name}: {run['in_a_scene']} of {run['keyframes']} keyframes in {run['scenes']} scenes, {_along(run)}, "
        f"{run['processor_s'] / run['keyframes']:.1f} s of processor a keyframe"
        for name, run in (("live", live), ("offline", offline))
    ]
    require(not live["loops"]["wrong_loop_links"] and not offline["loops"]["wrong_loop_links"], "no wrong loop")
    yield (
        "a film of 300 frames, live at one frame a second and by `replay --map`",
        f"{'; '.join(cells)}; offline takes {film['offline_over_live']:.2f} times as much processor in all; no wrong "
        f"loop; live {live['peak_mb'] / 1e3:.2f} GB (before the refinement kept less)",
        "`film.json`",
    )


def _along(walk: dict[str, Any], digits: int = 3) -> str:
    cameras = walk["cameras"]
    return (
        f"cameras within {cameras['position_percent_of_path']:.{digits}f} % of the way, "
        f"{cameras['rotation_deg_most']:.2f}°"
    )


def _loops(loops: dict[str, Any]) -> str:
    require(not loops["wrong_loop_links"] and not loops["wrong_chain_links"], "no loop is wrong")
    return f"{loops['loop_links']} loops, none wrong"


def endurance() -> str:
    """Faults, hostile clients, long runs."""
    return table(HEADER, [*_faults(), *_hostility(), *_capture()])


def _faults() -> Iterable[Row]:
    faults = raw("faults")["faults"].values()
    tried = sum(fault["tried"] for fault in faults)
    require(tried == sum(fault["good"] for fault in faults), "all trials are good")
    yield (
        f"{len(faults)} faults, from kill -9 to a wrong key, 20 times each",
        f"all {tried} trials ended with every acknowledged frame in a whole scene",
        "`faults.json`",
    )
    walk = raw("walk_faults")
    each = walk["faults"].values()
    require(len(each) == 12 and {f["tried"] for f in each} == {5} == {f["good"] for f in each}, "five times each")
    require(not walk["in_no_list"] and walk["maps"] == 1, "one map")
    yield (
        f"the same within one walk of {walk['photographs']} keyframes, five times each, over TCP with keys",
        f"after all {sum(f['tried'] for f in each)} the node went on; {walk['in_a_scene']} in one map, the other "
        f"{walk['photographs'] - walk['in_a_scene']} named with the reason; {_loops(walk['loops'])}; cameras within "
        f"{walk['cameras']['position_percent_of_path']:.3f} % of the way",
        "`walk_faults.json`",
    )
    pieces = raw("writes")["pieces"].values()
    runs = sum(sum(piece["runs"].values()) for piece in pieces)
    require(runs == sum(piece["good"] for piece in pieces), "all runs are good")
    yield (
        f"every write interrupted by a full disk, a failing one, kill -9: {sum(p['points'] for p in pieces)} points",
        f"all {runs} runs left the old whole or the new whole, and went on without help",
        "`writes.json`",
    )
    queues = raw("queue")["two_ends"], raw("queue")["processes"]
    for queue in queues:
        require(queue["refused_and_named"] == queue["refused"] and not queue["left"], "all refused are named")
        require(queue["acknowledged"] == queue["messages"] - queue["refused"], "the others are acknowledged")
    require(set(queues[1]["exit_codes"].values()) == {0}, "exit codes 0")
    yield (
        f"a queue of {queues[0]['messages']} keyframes, every third refused",
        f"{queues[0]['acknowledged']} acknowledged, {queues[0]['refused']} named, nothing restarted",
        "`queue.json`",
    )


def _hostility() -> Iterable[Row]:
    sieges = [raw("siege_ipc"), raw("siege_tcp")]
    require(all(not s["previews_lost"] and set(s["exit_codes"].values()) == {0} for s in sieges), "no preview lost")
    p99, p50 = (
        " and ".join(f"{siege[f'{name}_hostile_over_quiet'][figure]:.2f}" for siege in sieges)
        for name, figure in (("preview_ms", "p99"), ("keyframe_s", "p50"))
    )
    yield (
        "a hostile client on every socket, 200 requests a second: 8 minutes over ipc, 5 over tcp without a key",
        f"no preview lost; previews (99th percentile) take {p99} times, keyframes (median) {p50} times those of quiet "
        "phases",
        "`siege_ipc.json`, `siege_tcp.json`",
    )
    kills = raw("kills")
    require(not kills["lost"] and not kills["places_without_a_scene"], "no keyframe lost, no place without a scene")
    yield (
        f"kill -9 of capture or recon at random moments for {kills['minutes']:.0f} minutes, beside an undisturbed node",
        f"{kills['kills']['together']} kills: none of {kills['keyframes']} acknowledged keyframes lost, "
        f"{kills['scenes']} scenes as undisturbed",
        "`kills.json`",
    )
    fuzz = raw("fuzz")["campaigns"]["boundaries"]
    require(sum(row["cases"] for row in fuzz["rows"].values()) == fuzz["cases"], "cases of all boundaries")
    yield (
        f"{fuzz['cases'] / 1e6:.1f} million structured cases on {len(fuzz['rows'])} boundaries",
        f"{fuzz['defects']} defects in the last run; three runs before it found 23, of six kinds, repaired since",
        "`fuzz.json`",
    )
    soak = raw("soak")
    require(soak["previews_lost"] == 0 and max(soak["memory_change"].values()) < 0.01, "memory flat, no preview lost")
    yield (
        "an hour of replay at 30 frames a second",
        f"memory flat, no preview lost, previews within {soak['preview_latency_ms']['p99']:.0f} ms (99th percentile)",
        "`soak.json`",
    )


def _capture() -> Iterable[Row]:
    cost = part(raw("capture")["besides_decoding"], 2)
    yield "capture, 720p at 30 frames a second, besides decoding", f"{cost} of a core", "`capture.json`"
    pushed = raw("publisher")
    each, over = pushed["median_ms_a_frame"], pushed["publisher_over_camera"]
    require(over <= 0.05, "the publisher costs no more")
    yield (
        "`splatnode.Publisher` against a camera's own path, 720p",
        f"{each['publisher']:.2f} ms of processor a frame against {each['camera']:.2f} ({-100 * over:.1f} % less, "
        "within the noise)",
        "`publisher.json`",
    )


def batches() -> str:
    """Many recordings and many trials."""
    return table(HEADER, [*_batches(), *_cluster()])


def _batches() -> Iterable[Row]:
    row = raw("throughput")
    require(row["processors"] == 2, "two processors")
    yield (
        f"{row['recordings']} built-in captures, preset `{row['preset']}`, two at a time on two cores",
        f"{row['times_one_core']:.2f} times as many an hour as one at a time",
        "`throughput.json`",
    )
    row = raw("campaign")
    require(sum(row["outcomes"].values()) == row["trials"] and "failed" not in row["outcomes"], "none failed")
    seeds, rest = divmod(row["trials"], row["kinds"])
    in_an_hour = row["trials_in_a_core_hour"]
    require(rest == 0 and round(3600 * row["trials"] / row["processor_seconds"], -1) == round(in_an_hour, -1), "rate")
    yield (
        f"short trials of the stability matrix on one core: {row['kinds']} kinds, {seeds} seeds",
        f"{in_an_hour} in an hour of processor time; "
        f"{percent(row['reconstructing_seconds'] / row['processor_seconds'])} "
        f"of it reconstructs; {percent(row['outcomes']['accepted'] / row['trials'])} get a scene",
        "`campaign.json`",
    )
    row = raw("batch_simulation")
    last = row["last_life"]
    memory = last["memory_mb_after_a_tenth"], last["memory_mb_at_the_last_recording"]
    require(row["rows"] == row["as_expected"] == row["recordings"] and not row["hidden_files_left"], "each answered")
    require(row["results_whole"] == row["rows"] - row["verdicts"]["FAILED"], "all results whole")
    require(memory[1] < 1.05 * memory[0] and row["repeated_percent"] < 1, "flat memory, few repeated")
    yield (
        f"{thousands(row['recordings'])} simulated recordings, driver killed {row['kills_of_the_driver']} times",
        f"each has its one answer, {row['repeated']} repeated; driver {memory[0]:.1f} MB after a tenth, "
        f"{memory[1]:.1f} MB at the end",
        "`batch_simulation.json`",
    )


def _cluster() -> Iterable[Row]:
    row = raw("batch_ray")
    simulated, real = row["simulated"], row["real"]
    for each in (simulated, real):
        require(each["ledger_lines"] == each["recordings"], "one line a recording")
        require(each["hidden_files_left"] == each["other_folders"] == 0, "nothing half is left")
    require(simulated["rows"] == simulated["as_expected"] == simulated["recordings"], "each answered")
    yield (
        f"{simulated['recordings']} simulated recordings on two node processes of Ray on one machine; a worker killed, "
        "a node removed",
        f"each has its one answer, {simulated['repeated']} repeated, all {simulated['results_whole']} results whole",
        "`batch_ray.json`",
    )
    some, same = real["recordings"], real["the_same_to_the_bit"]
    require(real["rows"] == real["results_whole"] == some == real["compared_with_replay_alone"] == same, "all same")
    require(some == real["windows"] + real["built_in"] and not real["others"], "windows and captures")
    yield (
        f"{real['windows']} windows of three real photographs and {real['built_in']} built-in captures in the same way",
        f"all {some} results whole; {real['with_a_scene']} have a scene; all {same} the same to the bit as replayed "
        "alone, but for seconds and memory",
        "`batch_ray.json`",
    )


def viewer() -> str:
    """The viewer, and the parts of the core."""
    return table(HEADER, _viewer())


def _viewer() -> Iterable[Row]:
    for name, words in (
        ("viewer_hour", "an hour of scenes that grow and shrink"),
        ("viewer_live", "16 minutes, newer"),
    ):
        live = raw(name)["live"]
        late, memory = live["latency_ms"]["percentile_95"] / 1e3, live["memory_mb"]["at_the_end"]
        require(live["not_seen_within_10_s"] == 0, "all updates shown")
        require(memory >= max(live["memory_mb"]["median_of_each_twentieth"]), "memory at most that of the end")
        result = f"all {live['updates']} updates shown, 95 % within {late:.2f} s; at most {memory} MB"
        yield words, result, f"`{name}.json`"
    beside = raw("beside")
    intake, steps = (beside["ratios"][kind]["viewer"] for kind in ("intake_per_s", "iterations_per_s"))
    yield (
        f"viewer beside the node, {intake['rounds']} rounds",
        f"{percent(beside['taken'])} of both cores; intake of keyframes × {part(intake['median'], 2)} "
        f"({span(intake['range'])}), iterations × {steps['median']:.2f} ({span(steps['range'])})",
        "`beside.json`",
    )
    found = raw("viewer")
    points, splats = (found["pictures"][f"core {kind}"]["per_second_median"] for kind in ("points", "Gaussians"))
    agreement = found["agreement"]
    yield (
        f"{thousands(found['gaussians'])} points, then Gaussians, software Vulkan",
        f"{points:.0f}, {splats:.0f} pictures a second; off-screen it differs from Open3D by "
        f"{agreement['mean']:.1f} of "
        f"255 levels in the mean of {len(agreement['cameras'])} cameras",
        "`viewer.json`",
    )
    drag = raw("dragging")
    yield (
        f"{thousands(drag['gaussians'])} Gaussians, dragged by the mouse, software Vulkan",
        f"{drag['pictures_per_s']['median']:.1f} pictures a second; splash after {drag['splash_s']} s, scene after "
        f"{drag['scene_s']} s",
        "`dragging.json`",
    )
    web = raw("drive_web")
    yield (
        f"{thousands(web['pictures']['gaussians'])} Gaussians in headless Chromium, {web['graphics']}",
        f"{web['pictures']['per_second']:.1f} pictures a second; seen after {web['seen_after_s']:.2f} s",
        "`drive_web.json`",
    )
    clock = raw("rasterize")["cases"]["50k_512x384_all"]["clock_ms"]
    yield (
        "an iteration, 50 000 Gaussians, 512 x 384, all channels",
        f"{clock['median']:.1f} ms in the median, {clock['min']:.1f} at best",
        "`rasterize.json`",
    )
    pair = raw("priors")["figures"]["mast3r"]
    yield (
        "a pair of photographs in MASt3R's network, untrained weights",
        f"{pair['seconds_pair']:.0f} s, {pair['peak_rss_mb'] / 1e3:.1f} GB",
        "`priors.json`",
    )


BLOCKS = (rates, live_scenes, walks, endurance, batches, viewer)
