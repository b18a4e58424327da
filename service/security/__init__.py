"""Access control: API keys, tokens, scopes, rate limits, the audit log, and the rules while keys are off.

access_control  checks of a request: exposure (without keys), key or token, rate limit, scope, in this order
├── keys            creating, hashing and parsing keys; valid keys, cached for a few seconds
├── oidc            tokens of an OpenID Connect issuer, with the keys that it publishes
└── permissions     scopes, the scope of each route, the caller of a request
audit           entries of the audit log: changes at once, refusals counted per minute

Begin with `access_control.py`.
"""

from service.security.access_control import AccessControl, check_address
from service.security.audit import AuditTrail
from service.security.permissions import Permission, caller_of
