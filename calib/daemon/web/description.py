"""The OpenAPI description: FastAPI's own, completed by the stream's items and the token."""

from typing import Any

from fastapi import FastAPI
from pydantic import TypeAdapter

from calib.daemon.view.api_models import StreamItem

TOKEN = {"type": "http", "scheme": "bearer", "description": "TCP only; the Unix socket's file mode controls access"}


class Described(FastAPI):
    """An application that completes its description on the first request for it, which takes 0.2 s."""

    def openapi(self) -> dict[str, Any]:
        """The complete description."""
        if self.openapi_schema is None:
            _complete(super().openapi())
        return super().openapi()


def _complete(schema: dict[str, Any]) -> None:
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
