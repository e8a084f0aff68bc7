"""The OpenAPI description: FastAPI's own, with what it cannot know: the stream's items and the token."""

from typing import Any

from fastapi import FastAPI
from pydantic import TypeAdapter

from calib.daemon.models import StreamItem

TOKEN = {"type": "http", "scheme": "bearer", "description": "TCP only; the Unix socket's mode says who may come there"}


def describe_wholly(app: FastAPI) -> None:
    """Complete the description that the application gives of itself."""
    schema: dict[str, Any] = app.openapi()
    items = TypeAdapter(StreamItem).json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    components = schema["components"]
    for name, definition in items.pop("$defs").items():
        components["schemas"].setdefault(name, definition)
    components["schemas"]["StreamItem"] = items
    components["securitySchemes"] = {"token": TOKEN}
    schema["security"] = [{}, {"token": []}]
    events = schema["paths"]["/api/stream"]["get"]["responses"]["200"]["content"]["text/event-stream"]
    events["schema"] = {"type": "string", "contentMediaType": "application/json", "x-data": _reference("StreamItem")}


def _reference(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}
