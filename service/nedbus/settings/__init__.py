"""Settings from `nedbus.toml`, the environment and flags; no other package reads them."""

from .load import find_mistakes, load_client_settings, load_settings, locate_setting, locate_source, place_at
from .model import Settings, is_loopback, split_http
