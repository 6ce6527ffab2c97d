"""What is believed of an answer: where it may send us, and what a number in its headers is."""

from __future__ import annotations

import urllib.request
from typing import Any

from ..errors import InputError
from ..reading.files import short

MOST_DIGITS = 18


class _HttpOnly(urllib.request.HTTPRedirectHandler):
    """A server sends nobody to other protocols, such as FTP."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        if newurl.partition(":")[0].lower() not in ("http", "https"):
            raise InputError(f"{req.full_url}: expected http or https, the server sends to {short(newurl)}")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


OPENER = urllib.request.build_opener(_HttpOnly)


def whole_number(text: str | None) -> int | None:
    """A whole number of a header; None for anything else."""
    return int(text) if text and text.isascii() and text.isdecimal() and len(text) <= MOST_DIGITS else None
