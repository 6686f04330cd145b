"""The environments of the Safety Gym benchmark (Ray, Achiam, Amodei 2019).

The modules, from the lowest layer up: the configuration (`config`, `config_keys`), records of a
world (`world`), tables of rules (`robots`, `tasks`, `costs`, `elements`, `readings`), names
(`suite`), the compiled model (`building`, `bodies`), episodes (`layouts`, `draws`, `state`), lidars
and pictures (`lidar`, `renderer`), observations (`observations`), and the environment (`env`).
"""
