// What the page takes of mediabunny; README.md says how mediabunny-1.61.0.min.js is made from it.
export { EncodedPacket, EncodedVideoPacketSource, Mp4OutputFormat, Output, StreamTarget } from "mediabunny";
