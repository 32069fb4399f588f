from typing import Any, TypeAlias

Model: TypeAlias = Any

def __getattr__(name: str) -> Any: ...
