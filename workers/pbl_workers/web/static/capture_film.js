// Films: the camera's frames with their own times into an MP4 of the phone's storage.

import { EncodedPacket, EncodedVideoPacketSource, Mp4OutputFormat, Output, StreamTarget } from "/vendor/mediabunny-1.61.0.min.js";

/** Codecs in the order in which they are tried: what the container calls them, and what the encoder does. */
const CODECS = /** @type {const} */ ([["avc", "avc1.64002a"], ["avc", "avc1.4d402a"], ["avc", "avc1.42e02a"], ["vp9", "vp09.00.41.08"], ["av1", "av01.0.09M.08"]]);
/** With the most bits a second, ten minutes remain within what the server takes of a recording. */
const BITS_PER_PIXEL = 0.2, MOST_BITS = 12e6, KEY_EVERY_US = 2e6, MOST_WAITING = 12;

/** The back camera, as large and fast as is useful. */
export function openCamera() {
  const video = { facingMode: { ideal: "environment" }, width: { ideal: 1920 }, height: { ideal: 1080 }, frameRate: { ideal: 30, max: 60 } };
  return navigator.mediaDevices.getUserMedia({ audio: false, video });
}

/** Keep exposure and focus as they are now, where the browser can. @param {any} track */
async function lock(track) {
  const now = track.getSettings(), can = track.getCapabilities?.() ?? {};
  for (const [mode, ...values] of [["focusMode", "focusDistance"], ["exposureMode", "exposureTime", "iso"], ["whiteBalanceMode", "colorTemperature"]])
    if (can[mode]?.includes("manual") && values.every((name) => now[name] !== undefined))
      await track.applyConstraints({ advanced: [{ [mode]: "manual", ...Object.fromEntries(values.map((name) => [name, now[name]])) }] }).catch(() => {});
}

/** The frames of a camera as they come; `captured`: time of the page at which the last was captured, where the frame itself does not say it. @param {HTMLVideoElement} video @param {MediaStreamTrack} track */
function frames(video, track) {
  const Processor = /** @type {any} */ (globalThis).MediaStreamTrackProcessor;
  if (Processor) {
    const reader = new Processor({ track, maxBufferSize: 8 }).readable.getReader();
    return { captured: undefined, next: async () => (await reader.read()).value, end: () => reader.cancel().catch(() => {}) };
  }
  let ended = false;
  const source = { captured: /** @type {number|undefined} */ (undefined), next: () => Promise.resolve(), end: () => { ended = true; } };
  source.next = () => new Promise((/** @type {(f: any) => void} */ done) => {
    const wait = setTimeout(() => done(undefined), 1500);
    video.requestVideoFrameCallback((now, about) => {
      clearTimeout(wait);
      source.captured = about.captureTime;
      done(ended ? undefined : new VideoFrame(video, { timestamp: Math.round(1000 * (about.captureTime ?? 1000 * about.mediaTime)) }));
    });
  });
  return source;
}

/** @param {any} frame @param {number} rate */
async function configuration(frame, rate) {
  const [width, height] = [frame.codedWidth, frame.codedHeight];
  for (const [kind, codec] of CODECS) {
    const wanted = { codec, width, height, bitrate: Math.min(MOST_BITS, Math.round(BITS_PER_PIXEL * width * height * rate)), framerate: rate, latencyMode: /** @type {const} */ ("realtime") };
    if ((await VideoEncoder.isConfigSupported(wanted).catch(() => null))?.supported) return { kind, wanted };
  }
  throw new Error("no encoder");
}

/** One take. `ended` is called with a name of the texts where it ends by itself. */
export class Take {
  /** @param {MediaStream} stream @param {HTMLVideoElement} video @param {{write: (at: number, bytes: Uint8Array) => Promise<void>}} file @param {{make: string, model: string}} phone @param {(why: string) => void} ended */
  constructor(stream, video, file, phone, ended) {
    this.stream = stream, this.video = video, this.file = file, this.phone = phone, this.ended = ended;
    this.track = stream.getVideoTracks()[0];
    this.frames = 0, this.dropped = 0, this.how = "", this.startMs = 0, this.endMs = 0;
    /** Times of the frames that were written (us, of the camera's clock); for tests. @type {number[]} */
    this.times = [];
    this.running = true;
    /** @type {Promise<unknown>} */
    this.work = Promise.resolve();
    this.failed = "";
    /** @type {{end: () => void}|null} */
    this.source = null;
  }

  async start() {
    await lock(this.track);
    if (globalThis.VideoEncoder && (/** @type {any} */ (globalThis).MediaStreamTrackProcessor || "requestVideoFrameCallback" in this.video)) this.work = this.encode();
    else this.work = this.record();
    this.work.catch((error) => { this.failed = error.name; this.ended(error.name === "QuotaExceededError" ? "full" : "interrupted"); });
  }

  /** Frames to packets to the file, until `stop`. */
  async encode() {
    const source = frames(this.video, this.track), rate = this.track.getSettings().frameRate || 30;
    this.source = source;
    let frame = await source.next();
    if (!frame) return;
    const { kind, wanted } = await configuration(frame, rate);
    const size = [frame.codedWidth, frame.codedHeight].join();
    const output = new Output({
      format: new Mp4OutputFormat({ fastStart: "fragmented", minimumFragmentDuration: 1, metadataFormat: "mdta" }),
      target: new StreamTarget(new WritableStream({ write: ({ data, position }) => this.file.write(position, data) })),
    });
    const packets = new EncodedVideoPacketSource(kind);
    output.addVideoTrack(packets, { rotation: frame.rotation ?? 0 });
    // As phones name themselves and their lens: a calibration that is registered for them is found (`pbl camera`).
    const { make, model } = this.phone;
    output.setMetadataTags({ date: new Date(), raw: { "com.android.manufacturer": make, "com.android.model": model, "com.apple.quicktime.camera.lens_model": this.track.label } });
    await output.start();
    frame.close();
    let first = NaN, last = NaN, key = -Infinity, apart = Infinity, usual = 1e6 / rate;
    let adding = Promise.resolve();
    /** @type {any} */
    let broken = null;
    const encoder = new VideoEncoder({
      output: (chunk, about) => {
        const packet = EncodedPacket.fromEncodedChunk(chunk);
        const own = packet.clone({ timestamp: packet.timestamp - first / 1e6 });
        adding = adding.then(() => packets.add(own, about)).catch((error) => { broken ??= error; });
      },
      error: (error) => { broken ??= error; },
    });
    encoder.configure(wanted);
    while (this.running && !broken && (frame = await source.next())) {
      const now = performance.now(), time = frame.timestamp, gap = time - last;
      if (size !== [frame.codedWidth, frame.codedHeight].join() || gap <= 0 || gap > 2e6) {
        this.ended(gap <= 0 || gap > 2e6 ? "clock" : "turned");
        frame.close();
        break;
      }
      if (gap > 1.5 * usual) this.dropped += Math.round(gap / usual) - 1;
      if (gap < 1.5 * usual) usual += 0.1 * (gap - usual);
      else if (gap > 0) usual += 0.02 * (gap - usual);  // a camera that slows down in the dark
      last = time;
      const captured = frame.metadata?.().captureTime ?? source.captured;
      apart = captured === undefined ? Math.min(apart, 1000 * now - time) : 1000 * captured - time;
      if (encoder.encodeQueueSize > MOST_WAITING) this.dropped += 1;
      else {
        if (Number.isNaN(first)) first = time;
        encoder.encode(frame, { keyFrame: time - key >= KEY_EVERY_US });
        if (time - key >= KEY_EVERY_US) key = time;
        this.frames += 1;
        this.times.push(time);
        this.startMs = (first + apart) / 1000;
        this.endMs = (time + apart) / 1000;
      }
      frame.close();
    }
    source.end();
    if (!broken) await encoder.flush();
    await adding;
    if (broken) throw broken;
    if (this.frames) await output.finalize();
    this.how = wanted.codec;
  }

  /** Without an encoder: the browser's own recorder, whose times are less exact. */
  async record() {
    const recorder = new MediaRecorder(this.stream, { videoBitsPerSecond: 8e6 });
    let at = 0, writing = Promise.resolve();
    recorder.ondataavailable = ({ data }) => {
      writing = writing.then(async () => {
        const bytes = new Uint8Array(await data.arrayBuffer());
        await this.file.write(at, bytes);
        at += bytes.length;
      });
    };
    recorder.onstart = () => { this.startMs = performance.now(); };
    recorder.start(1000);
    const done = new Promise((go) => { recorder.onstop = go; });
    while (this.running) {
      await new Promise((go) => setTimeout(go, 100));
      this.endMs = performance.now();
    }
    recorder.stop();
    await done;
    await writing;
    this.frames = 1, this.how = recorder.mimeType;
  }

  /** End, and have all of it in the file. */
  async stop() {
    this.running = false;
    this.source?.end();  // a camera that has stopped delivers nothing to wait for
    await this.work.catch(() => {});
  }
}
