"""Data sheets: a joint's own EDS is used, its identity expected, and one that lacks what the link needs is refused."""

from pathlib import Path

import pytest
import yaml

from armlink.arm_file import bundled_arms, parse_arm
from armlink.cli import run
from armlink.drives.canopen import eds_file as data_sheet
from armlink.errors import BadInput, Refused
from armlink.link.link import Link
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

OURS = Path(data_sheet.bundled_path()).read_text()


@pytest.fixture
def sheet(tmp_path):
    def write(name="maker.eds", **changes):
        text = OURS
        for old, new in changes.values():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write


def section_of(index, sub=None):
    """A whole section of the shipped sheet, as text."""
    name = f"[{index:X}]" if sub is None else f"[{index:X}sub{sub}]"
    start = OURS.index(name)
    end = OURS.find("\n[", start + 1)
    return OURS[start : end if end > 0 else len(OURS)]


def test_a_joints_own_sheet_is_used_and_the_others_keep_ours(arm_of, sheet):
    arm = arm_of(2, joint={"eds": sheet(name_of=("ProductName=armlink joint", "ProductName=Torquer 3"))})
    first = arm.link.joints[0]
    mixed = arm.model_copy(
        update={
            "link": arm.link.model_copy(update={"joints": (first, arm.link.joints[1].model_copy(update={"eds": None}))})
        }
    )
    names = [each.device_information.product_name for each in data_sheet.of_joints(mixed, mixed.link.joints)]
    assert names == ["Torquer 3", "armlink joint"]


def test_a_path_is_taken_from_the_arm_file(arm_of, tmp_path, sheet):
    sheet()
    arm = arm_of(joint={"eds": "maker.eds"}).model_copy(update={"path": tmp_path / "arm.yaml"})
    assert data_sheet.of_joints(arm, arm.link.joints)[0].get_variable(0x2100, 1).name


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ({}, {"vendor": 0x11, "product": 0x22}),
        ({"product": 0x23}, {"vendor": 0x11, "product": 0x23}),
        ({"serial": 7}, {"vendor": 0x11, "product": 0x22, "serial": 7}),
    ],
)
def test_vendor_and_product_of_the_sheet_are_expected_unless_the_arm_file_says_otherwise(
    arm_of, sheet, stated, expected
):
    path = sheet(vendor=("VendorNumber=0\n", "VendorNumber=0x11\n"), product=("0x41524D4C", "0x22"))
    arm = arm_of(joint={"eds": path, "identity": stated})
    found = data_sheet.expected_identity(arm.link.joints[0], data_sheet.of_joints(arm, arm.link.joints)[0])
    assert found.model_dump(exclude_none=True) == expected


def test_a_sheet_of_another_product_is_refused_before_anything_is_written(arm_of, bus, sheet):
    path = sheet(vendor=("VendorNumber=0\n", "VendorNumber=0x11\n"), product=("0x41524D4C", "0x99"))
    with (
        Link(arm_of(joint={"eds": path}), bus) as link,
        pytest.raises(
            Refused, match=r"1018h:02 product code is 0x22, expected 0x99: .* `identity` or `eds` of this joint"
        ),
    ):
        link.start()
    assert not [data for can_id, data in bus.sent if can_id == 0x601 and data[0] & 0xE0 == 0x20]


def test_a_sheet_of_the_right_product_starts_the_link(arm_of, bus, sheet):
    path = sheet(vendor=("VendorNumber=0\n", "VendorNumber=0x11\n"), product=("0x41524D4C", "0x22"))
    with Link(arm_of(joint={"eds": path}), bus) as link:
        link.start()
        link.enable()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"gone": (section_of(0x6077), "")}, r"lacks 6077h:00 torque actual value, which the link needs"),
        ({"short": ("DataType=0x0004\n", "DataType=0x0003\n")}, r"has 16 bits, expected 32"),
        (
            {"unmapped": ("PDOMapping=1", "PDOMapping=0")},
            r"cannot be mapped into a PDO, .* in RPDO1",
        ),
        ({"torn": ("[DeviceInfo]", "[DeviceInfo")}, r"not a valid EDS"),
    ],
)
def test_what_a_sheet_lacks_is_named(arm_of, sheet, changes, complaint):
    arm = arm_of(joint={"eds": sheet(**changes)})
    with pytest.raises(BadInput, match=complaint) as caught:
        data_sheet.of_joints(arm, arm.link.joints)
    assert "joint_1: data sheet" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_object_that_a_controller_may_lack_may_be_missing(arm_of, sheet):
    arm = arm_of(joint={"eds": sheet(gone=(section_of(0x60B2), ""))})
    data_sheet.of_joints(arm, arm.link.joints)


@pytest.mark.parametrize(("name", "complaint"), [("none.eds", "No such file"), ("sheet.txt", "ends in .eds or .dcf")])
def test_a_file_that_is_no_sheet_is_one_line_of_the_command(tmp_path, capsys, name, complaint):
    content = yaml.safe_load(bundled_arms()["sarcos"].read_text())
    content["link"]["joints"][2]["eds"] = name
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(content))
    assert run(["check", str(tmp_path / "arm.yaml"), "--bus", "armlink_sim:sarcos", "--passive"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert "joint_3: data sheet" in error[0]
    assert complaint in error[0]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_a_makers_umlauts_are_read(arm_of, tmp_path, encoding):
    """CiA 306 says ASCII; Windows tools write their own code page, newer ones UTF-8 with or without a mark."""
    text = OURS.replace("ProductName=armlink joint", "ProductName=Würfel °")
    (tmp_path / "maker.eds").write_bytes(text.encode(encoding))
    arm = arm_of(joint={"eds": str(tmp_path / "maker.eds")})
    sheets = data_sheet.of_joints(arm, arm.link.joints)
    assert sheets[0].device_information.product_name == "Würfel °"


def test_a_stock_drives_sheet_is_told_how_to_read_its_torque(arm_of, sheet):
    arm = arm_of(joint={"eds": sheet(other=("2100", "2900"))})
    with pytest.raises(BadInput, match=r"no torque sensor record 2100h: .*torque: motor") as caught:
        data_sheet.of_joints(arm, arm.link.joints)
    assert "wiring" not in str(caught.value)


def test_the_simulated_arm_is_the_controller_that_the_arm_file_states(sheet):
    """A file is rehearsed as it is, a maker's identity and data sheet included."""
    content = yaml.safe_load(bundled_arms()["parallel6"].read_text())
    path = sheet(vendor=("VendorNumber=0\n", "VendorNumber=0x11\n"))
    content["link"]["joints"][1] |= {"eds": path, "identity": {"product": 0x77, "serial": 5}}
    arm = parse_arm(content, Path(path).with_name("arm.yaml"))
    with Link(arm, LockStepBus(arm=SimulatedArm(arm, Truth.of(arm)))) as link:
        assert not any(each.mismatch for each in link.scan())
        link.start()
