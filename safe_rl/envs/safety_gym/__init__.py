"""The environments of the Safety Gym benchmark (Ray, Achiam, Amodei 2019).

The modules, from the lowest layer up: the configuration (`config`, `config_keys`), records of a
world (`world`), tables of rules (`robots`, `tasks`, `costs`, `elements`), names (`suite`), what is
observed (`lidar`, `observations`), the compiled model (`building`), its episodes (`layouts`,
`episodes`), pictures (`renderer`), and the environment (`env`).
"""
