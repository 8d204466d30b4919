from setuptools import setup

setup(name="walk", version="0.1", install_requires=["gymnasium", "networkx"])
