// The data block: arrays of whole numbers as e2rl/report/failure_tracks.py writes them.

/** Bytes of base64 of zlib. */
async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const inflated = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(inflated).arrayBuffer());
}

/** Whole numbers of base64, zlib, four byte planes and zigzag code. */
async function decodeIntegers(text) {
  const bytes = await inflate(text);
  const count = bytes.length / 4;
  return Int32Array.from({ length: count }, (_, k) => {
    const code = bytes[k] | (bytes[count + k] << 8) | (bytes[2 * count + k] << 16) | (bytes[3 * count + k] << 24);
    return (code >>> 1) ^ -(code & 1);
  });
}

/** Rows of `length` values, times `quantum`, from their second differences. */
function integrate(differences, length, quantum = 1) {
  const rows = [];
  for (let begin = 0; begin < differences.length; begin += length) {
    const row = new Float64Array(length);
    for (let k = 0, slope = 0, value = 0; k < length; k++) {
      slope += differences[begin + k];
      value += slope;
      row[k] = value * quantum;
    }
    rows.push(row);
  }
  return rows;
}

/** A replay with its tracks: {role, length, width, x, y, heading, speed, present, gap}, the last six over steps. */
async function decodeReplay(replay, channels) {
  const names = Object.keys(channels);
  const motion = await decodeIntegers(replay.motion);
  const steps = motion.length / names.length / replay.tracks.length;
  const rows = integrate(motion, steps);
  const tracks = replay.tracks.map(([role, length, width], index) => {
    const track = { role, length, width };
    names.forEach((name, channel) => {
      track[name] = rows[channel * replay.tracks.length + index].map((value) => value * channels[name]);
    });
    return track;
  });
  return { ...replay, tracks, steps, plans: replay.plans && (await decodePlans(replay, channels.x)) };
}

/** Plans with agents {track, letter (of an adversary), paths (of [x, y], one a plan), targets (a track or -1)}. */
async function decodePlans({ plans, tracks }, quantum) {
  const [points, targets] = await Promise.all([decodeIntegers(plans.points), decodeIntegers(plans.targets)]);
  const count = targets.length / plans.agents.length;
  const rows = integrate(points, points.length / (2 * targets.length), quantum);
  const letters = [..."ABCDEFGHIJKLMNOPQRSTUVWXYZ"];
  const agents = plans.agents.map((track, index) => {
    const numbers = Array.from({ length: count }, (_, number) => index * count + number);
    const paths = numbers.map((number) => Array.from(rows[2 * number], (x, k) => [x, rows[2 * number + 1][k]]));
    const letter = tracks[track][0] === "adversary" ? letters.shift() : undefined;
    return { track, letter, paths, targets: numbers.map((number) => targets[number]) };
  });
  return { ...plans, count, agents };
}

/** Lines of a map as arrays of [x, y]. */
async function decodeLines(map, name, quantum) {
  const [points, counts] = await Promise.all([
    decodeIntegers(map[`${name}_points`]),
    decodeIntegers(map[`${name}_counts`]),
  ]);
  if (!points.length) return [];
  const [x, y] = integrate(points, points.length / 2, quantum);
  let begin = 0;
  return Array.from(counts, (count) => {
    const line = Array.from({ length: count }, (_, k) => [x[begin + k], y[begin + k]]);
    begin += count;
    return line;
  });
}

async function decodeMap(map, quantum) {
  const [lanes, drivable, widths] = await Promise.all([
    decodeLines(map, "lane", quantum),
    decodeLines(map, "drivable", quantum),
    decodeIntegers(map.lane_width),
  ]);
  return { lanes, drivable, widths: Array.from(widths, (width) => width * quantum) };
}

/** Decoded replays with the paths of their maps; both are kept once decoded. */
class Store {
  constructor(report) {
    Object.assign(this, { report, replays: new Map(), maps: new Map() });
  }

  replay(index) {
    if (!this.replays.has(index)) this.replays.set(index, this.decode(this.report.replays[index]));
    return this.replays.get(index);
  }

  async decode(raw) {
    const [replay, paths] = await Promise.all([decodeReplay(raw, this.report.channels), this.map(raw.map)]);
    return { replay, paths };
  }

  map(index) {
    const { maps, map_quantum: quantum } = this.report;
    if (!this.maps.has(index)) this.maps.set(index, decodeMap(maps[index], quantum).then(mapPaths));
    return this.maps.get(index);
  }
}
