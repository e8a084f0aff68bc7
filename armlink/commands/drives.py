"""Lists the drive families that are installed, and what their drives are like."""

from armlink.commands.options import Json


def drives(json: Json = None) -> int:
    """List the drive families with their traits: torque, calibration, silence, bounds, cadence, frames.

    Example: armlink drives --json -
    """
    from rich.box import SIMPLE
    from rich.table import Table

    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from armlink.drives.family import family, family_names

    found = [family(name) for name in family_names()]
    columns = ("torque", "calibration", "silence", "bounds", "cadence", "frame")
    table = Table("family", *columns, "devices", box=SIMPLE)
    for each in found:
        traits = each.traits.as_json()
        cells = [", ".join(traits[name]) if name == "bounds" else traits[name] for name in columns]
        table.add_row(each.name, *cells, each.summary)
    out = results(json)
    out.print(table)
    out.print(f"{len(found)} drive families are installed")
    write_json(json, [{"family": each.name, "traits": each.traits.as_json()} for each in found])
    return 0
