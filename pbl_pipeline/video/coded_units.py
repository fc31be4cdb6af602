"""Damage in the coded pictures of H.264 and HEVC, seen from the units (NAL units) of a packet without decoding.

MP4, MOV and MKV store a length before each unit, and no coded slice contains three zero bytes in a row (ITU-T H.264,
7.4.1; H.265, 7.4.2). Zeros where a part of a file is missing always break one of these rules, other bytes often.
FFmpeg and the decoder of a GPU draw most such pictures without an error. Figures: research/reports.
"""

from __future__ import annotations

from av.codec import CodecContext

#: Place of the size of the lengths in a codec's configuration (ISO/IEC 14496-15: avcC, hvcC), and the bits of a unit's
#: first byte that hold its type.
_FORMS = {"h264": (4, 0x1F), "hevc": (21, 0x7E)}
#: Of these types are the coded slices.
_SLICES = {"h264": range(1, 6), "hevc": range(0x40)}


def is_damaged(codec: CodecContext, packet: bytes) -> bool:
    """Return whether a packet of H.264 or HEVC is damaged; False where its units have start codes, as in a .ts file."""
    place, of_type = _FORMS.get(codec.name, (0, 0))
    configuration = codec.extradata or b""
    if not place or len(configuration) <= place or configuration[0] != 1:
        return False
    size, at = (configuration[place] & 3) + 1, 0
    while at < len(packet):
        begin = at + size
        at = begin + int.from_bytes(packet[at:begin], "big")
        if not begin < at <= len(packet):
            return True
        # Some encoders append zeros.
        if packet[begin] & of_type in _SLICES[codec.name] and b"\0\0\0" in packet[begin:at].rstrip(b"\0"):
            return True
    return False
