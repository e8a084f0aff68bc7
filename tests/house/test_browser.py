"""The fixture that looks at pages notices what is wrong with one."""

import pytest

DRAWN = "<h1 style='color:#c00'>A report</h1><div id=a></div><script>a.textContent = 'drawn by ' + 'script'</script>"


def test_a_page_is_seen_as_it_stands_after_its_scripts(look, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(DRAWN)
    seen = look(page)
    assert "drawn by script" in seen.document.partition("<script>")[0]
    assert seen.colours() > 10
    assert seen.console == ()


@pytest.mark.parametrize("script", ["throw new Error('boom')", "console.error('boom')", "setTimeout(() => boom(), 10)"])
def test_a_script_s_complaint_is_noticed(look, tmp_path, script):
    page = tmp_path / "page.html"
    page.write_text(f"<script>{script}</script>")
    seen = look(page)
    assert "boom" in " ".join(seen.console)
    assert seen.colours() == 1
