// What the viewer on the other side has: asked for again and again, each answer as soon as there is something new.

const AGAIN_MS = 1000; // after a failure

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/** Calls `heard(news)` for every news, `lost(why)` when there is no answer, for ever. */
export async function listen(heard, lost) {
  let run = "";
  let number = -1;
  for (;;) {
    try {
      const answer = await fetch(`/told?run=${run}&number=${number}`);
      if (answer.status === 401 || answer.status === 403) lost(await answer.text());
      if (!answer.ok) throw new Error(`status ${answer.status}`);
      const news = await answer.json();
      ({ run, number } = news);
      await heard(news);
    } catch (error) {
      if (error instanceof TypeError) lost("no connection to splatnode view: trying again");
      await pause(AGAIN_MS);
    }
  }
}

/** The bytes of a .splat file; null where that version is no longer there. */
export async function fetchGaussians(version) {
  const answer = await fetch(`/gaussians/${version}`);
  return answer.ok ? answer.arrayBuffer() : null;
}

/** What stands beside the Gaussians, with `ends` in each of its lines; null where that version is no longer there. */
export async function fetchShapes(version) {
  const answer = await fetch(`/shapes/${version}`);
  if (!answer.ok) return null;
  const bytes = await answer.arrayBuffer();
  const length = new DataView(bytes).getUint32(0, true);
  const shapes = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  const numbers = new Float32Array(bytes, 4 + length);
  for (const lines of shapes.lines) lines.ends = numbers.subarray(lines.at, lines.at + 6 * lines.count);
  return { ...shapes, version };
}
