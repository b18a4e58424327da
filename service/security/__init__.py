"""Access control: API keys, scopes, rate limits, and the rules while keys are off.

access_control  checks of a request: exposure, key, rate, scope, in this order
├── exposure        without keys: local requests only, unless configured otherwise
├── keys            creating, hashing and parsing keys
├── key_cache       valid keys, cached for a few seconds
├── rate_limits     requests per key, and invalid keys per client address
└── permissions     scopes, the scope of each route, the caller of a request

Begin with `access_control.py`.
"""

from service.security.access_control import AccessControl
from service.security.exposure import check_address
from service.security.permissions import Permission, caller_of

__all__ = ["AccessControl", "Permission", "caller_of", "check_address"]
