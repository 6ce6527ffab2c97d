"""A small RTSP server on this machine: one MPEG transport stream over the control connection (RFC 2326, RFC 2250)."""

from __future__ import annotations

import socketserver
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PACKET = 188 * 7  # bytes of the stream in one RTP packet
PAYLOAD_MP2T = 33
SDP = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\nm=video 0 RTP/AVP 33\r\na=control:track\r\n"


class _Handler(socketserver.StreamRequestHandler):
    server: _Server

    def handle(self) -> None:
        while line := self.rfile.readline().decode():
            method = line.split()[0]
            heads = {}
            while head := self.rfile.readline().decode().strip():
                name, _, value = head.partition(":")
                heads[name.lower()] = value.strip()
            answer = {
                "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n",
                "DESCRIBE": f"Content-Type: application/sdp\r\nContent-Length: {len(SDP)}\r\n",
                "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n",
                "PLAY": "Session: 1\r\n",
            }.get(method, "")
            body = SDP if method == "DESCRIBE" else ""
            self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq: {heads.get('cseq', 0)}\r\n{answer}\r\n{body}".encode())
            if method == "PLAY":
                self._play()
                return

    def _play(self) -> None:
        data = self.server.stream
        for number, at in enumerate(range(0, len(data), PACKET)):
            stamp = int(90_000 * self.server.seconds * at / len(data))
            rtp = struct.pack(">BBHII", 0x80, PAYLOAD_MP2T, number & 0xFFFF, stamp, 1) + data[at : at + PACKET]
            self.wfile.write(struct.pack(">BBH", 0x24, 0, len(rtp)) + rtp)
            time.sleep(self.server.seconds * PACKET / len(data))


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = allow_reuse_address = True
    stream: bytes
    seconds: float


@contextmanager
def rtsp_server(stream: bytes, seconds: float) -> Iterator[str]:
    """The URL of a server that plays the bytes of an MPEG transport stream in so many seconds, once a connection."""
    with _Server(("127.0.0.1", 0), _Handler) as server:
        server.stream, server.seconds = stream, seconds
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield f"rtsp://127.0.0.1:{server.server_address[1]}/live"
        server.shutdown()
