"""Package ``gdp_proxy`` for colcon. The program itself is in the Python package gdp-ros."""

from setuptools import setup

setup(
    name="gdp_proxy",
    version="0.1.0",
    packages=["gdp_proxy"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/gdp_proxy"]),
        ("share/gdp_proxy", ["package.xml"]),
        ("share/gdp_proxy/launch", ["launch/proxy.launch.py"]),
        ("share/gdp_proxy/config", ["config/proxy.params.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The gdp-ros authors",
    maintainer_email="gdp-ros@packages.invalid",
    description="Proxy of the Global Data Plane as a ROS 2 package",
    license="Apache-2.0",
    entry_points={"console_scripts": ["proxy = gdp_proxy.proxy:main"]},
)
