"""Content negotiation (RFC 9110, sections 5.3, 12.5.1 and 13.1.2)."""

from collections.abc import Sequence

from starlette.datastructures import Headers

from service.errors import NotAcceptable

#: In place of tags: any of them.
ANY = "*"


def listed(headers: Headers, name: str) -> str | None:
    """Value of a header that holds a list, its lines joined as if they were one; None when it is not there."""
    lines = headers.getlist(name)
    return ", ".join(lines) if lines else None


def negotiate(accept: str | None, offered: Sequence[str]) -> str:
    """The offered media type that the client likes best; of equals the first one offered.

    Raises:
        NotAcceptable: the client accepts none of them.
    """
    if accept is None or not accept.strip():
        return offered[0]
    ranges = [_parse_range(item) for item in accept.split(",") if item.strip()]
    best = max(offered, key=lambda media: _quality(media, ranges))
    if _quality(best, ranges) <= 0.0:
        raise NotAcceptable(f"The header Accept must allow one of: {', '.join(offered)}.")
    return best


def etags_of(if_none_match: str | None) -> frozenset[str]:
    """The tags that the client holds, to be compared weakly; `ANY` stands for whatever there is."""
    return frozenset(tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(","))


def _parse_range(text: str) -> tuple[str, float]:
    media, *parameters = (part.strip() for part in text.split(";"))
    quality = next((p[2:] for p in parameters if p.lower().startswith("q=")), "1")
    try:
        return media.lower(), min(max(float(quality), 0.0), 1.0)
    except ValueError:
        return media.lower(), 0.0


def _quality(media: str, ranges: Sequence[tuple[str, float]]) -> float:
    kinds = (media, f"{media.split('/')[0]}/*", "*/*")
    return next((quality for kind in kinds for name, quality in ranges if name == kind), 0.0)
