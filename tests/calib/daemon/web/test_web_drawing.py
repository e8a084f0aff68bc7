"""The drawing of the arm on the page: its geometry against SciPy, its colours against the residuals."""

from typing import Any

import numpy as np
from made_up_view import MadeUpView
from playwright.sync_api import Browser, Page, expect
from scipy.spatial.transform import Rotation
from served_page import Served, open_page

from calib.daemon.web.server import joined


def test_its_motions_are_rotations_about_axes_in_space(browser: Browser) -> None:
    rng = np.random.default_rng(5)
    axes = rng.normal(size=(3, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    points, angles, tip = rng.normal(size=(3, 3)), rng.uniform(-3, 3, 3), rng.normal(size=3)
    page = browser.new_page()
    found = page.evaluate(
        f"([axes, points, angles, tip]) => {{ {joined('solids.js')}; let motion = STAND;"
        " axes.forEach((axis, k) => { motion = after(motion, axis, points[k], angles[k]); });"
        " return [moved(motion, tip), rotated(motion, tip)]; }",
        [each.tolist() for each in (axes, points, angles, tip)],
    )
    turned, at = Rotation.identity(), tip
    for axis, point, angle in reversed(list(zip(axes, points, angles, strict=True))):
        own = Rotation.from_rotvec(angle * axis)
        at, turned = own.apply(at - point) + point, own * turned
    np.testing.assert_allclose(found, [at, turned.apply(tip)], atol=1e-12)


def test_its_solids_are_closed_and_face_outwards(browser: Browser) -> None:
    page = browser.new_page()
    faces: Any = page.evaluate(
        f"() => {{ {joined('solids.js')}; return drum([1, 2, 3], unit([1, 2, -1]), 0.3, 0.5); }}"
    )
    centre, outwards, area = np.array([1.0, 2.0, 3.0]), [], np.zeros(3)
    for face in faces:
        corners, normal = np.array(face["points"]), np.array(face["normal"])
        outwards.append((corners.mean(axis=0) - centre) @ normal)
        crossed = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0) / 2
        area += normal * np.linalg.norm(crossed)
    assert min(outwards) > 0.25
    np.testing.assert_allclose(area, 0.0, atol=1e-9)  # of any closed surface


def test_the_arm_is_drawn_in_colours_of_its_residuals(browser: Browser, server: Served, view: MadeUpView) -> None:

    def begin() -> None:
        view.moves, view.t, view.shift = False, 60.0, 0.3

    server.do(begin)
    page = open_page(browser, server)
    expect(page.locator("#arm-section")).to_be_visible()
    server.do(view.tick)
    worst = "The arm as it stands now: largest residual joint_2, +0.32 N·m"
    expect(page.locator("#arm-view")).to_have_attribute("aria-label", worst)
    before = colours(page)
    assert before["green"] > 500, before
    assert before["warm"] > 100, before
    page.get_by_role("button", name="Turn the view left").click()
    assert colours(page) != before
    view.shift, view.moves = 0.0, True
    for _ in range(40):
        server.do(view.tick)
        page.wait_for_timeout(20)
    expect(page.locator("#arm-view")).to_have_attribute("aria-label", "The arm as it stands now: moving")
    moving = colours(page)
    assert moving["green"] == moving["warm"] == 0
    assert moving["any"] > 1000
    assert page.complaints == []  # type: ignore[attr-defined]


def colours(page: Page) -> dict[str, int]:
    """Pixels of the drawing that are green, that are orange or red, and that are anything."""
    return page.evaluate("""() => {
      const canvas = document.getElementById('arm-view');
      const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      const found = { green: 0, warm: 0, any: 0 };
      for (let k = 0; k < data.length; k += 4) {
        const [red, green, blue, alpha] = data.slice(k, k + 4);
        found.any += alpha > 200;
        found.green += alpha > 200 && green > 1.4 * red && green > 1.2 * blue;
        found.warm += alpha > 200 && red > 1.8 * green;
      }
      return found;
    }""")
