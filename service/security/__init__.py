"""Who may do what: API keys, their scopes and rates, and what holds while there are none.

access_control  what happens to a request: exposure, key, rate, scope, in this order
├── exposure        without keys: only over loopback or a Unix socket, unless told otherwise
├── keys            making, hashing and reading keys
├── key_cache       which keys are valid: the store's, remembered for a few seconds
├── client_network  which client addresses count as one
├── rate_limits     requests per key, and refused keys per client address
└── permissions     scopes, which route needs which, and on whose behalf a request comes

Begin with `access_control.py`.
"""

from service.security.access_control import AccessControl
from service.security.exposure import check_address
from service.security.permissions import Permission, caller_of

__all__ = ["AccessControl", "Permission", "caller_of", "check_address"]
