"""Comments in XML files."""


def xml_comment(lines: list[str]) -> str:
    """Lines as an XML comment; two hyphens, which would end it, are parted."""
    text = "\n  ".join(lines)
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!-- {text}\n-->\n"
