"""Package ``grasp`` for colcon: the planner and the client of ``examples/listing1.launch.py``."""

from setuptools import setup

setup(
    name="grasp",
    version="0.1.0",
    packages=["grasp"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/grasp"]),
        ("share/grasp", ["package.xml"]),
    ],
    install_requires=["setuptools", "numpy", "scipy", "opencv-python-headless"],
    zip_safe=True,
    maintainer="The gdp-ros authors",
    maintainer_email="gdp-ros@packages.invalid",
    description="Grasp planning on depth frames as a ROS service, and its client",
    license="Apache-2.0",
    entry_points={"console_scripts": ["planner = grasp.planner:main", "client = grasp.client:main"]},
)
