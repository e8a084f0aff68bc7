"""The XML of URDF and MJCF files, read as leniently as the readers of ROS and MuJoCo do."""

import xml.etree.ElementTree as ET
from xml.parsers import expat


class NotXml(ValueError):
    """Not well-formed XML."""


def parse_xml(source: bytes) -> ET.Element:
    """The root element of a model file; raises NotXml, in one line.

    Names with a colon stay as they are: published URDF files have tags such as `drake:acceleration` whose prefix they
    do not declare. Readers without namespaces, as those of ROS and MuJoCo, take them; xml.etree by itself refuses.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(source, True)
    except expat.ExpatError as error:
        raise NotXml(str(error)) from None
    return builder.close()
