"""`AsyncClient`, from which `make client` generates `blocking/`.

Begin with `client.py`.
"""
