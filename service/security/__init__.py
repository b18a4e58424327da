"""Who may do what: API keys, their scopes and rates, and what holds while there are none.

middleware   what happens to a request: exposure, key, rate, scope, in this order
├── exposure     without keys: only over loopback or a Unix socket, unless told otherwise
├── keys         making, hashing and reading keys
├── key_ring     which keys are valid: the store's, remembered for a few seconds
├── limits       requests per key, and refused keys per client address
└── access       scopes, which route needs which, and on whose behalf a request comes
description  all of it in the API description
"""
