"""The messages that nedbus has a definition of, one file each."""

from importlib import import_module
from pkgutil import iter_modules

from nedbus_msgs.model.declaration import DEFAULT_TOPIC
from nedbus_msgs.model.definition import MESSAGES

for _name in sorted((module.name for module in iter_modules(__path__)), key=lambda name: (name != DEFAULT_TOPIC, name)):
    import_module(f"{__name__}.{_name}")

globals().update({name: definition.model for name, definition in MESSAGES.items()})
