"""Comments in XML files."""

from armlink.content.printable_text import printable_text


def xml_comment(lines: list[str]) -> str:
    """Lines as an XML comment; two hyphens, which would end it, are parted."""
    text = "\n  ".join(map(printable_text, lines))
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!-- {text}\n-->\n"
