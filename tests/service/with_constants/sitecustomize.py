"""Gives constants that stand beside the settings values from the environment, in processes of services."""

import json
import os

from service.settings import CONSTANTS, Settings

for name, value in json.loads(os.environ.get("TEST_CONSTANTS", "{}")).items():
    group, attribute = CONSTANTS[name]
    setattr(type(Settings.model_fields[group].default), attribute, value)
