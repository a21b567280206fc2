# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Package the calibrator for colcon (ament_python) and for pip."""

from glob import glob
from multiprocessing.pool import ThreadPool
import os
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

try:
    from pybind11 import get_include
    HEADERS = [get_include()]
except ImportError:  # rosdep knows only the package pybind11-dev, which puts them into /usr/include
    HEADERS = []

NAME = 'dlo_calibration'
SHARED_FOLDERS = ('config', 'launch', 'msg_samples')
CORE = f'{NAME}/simulation/core'
MORE_FLAGS = os.environ.get('DLO_CXXFLAGS', '').split()  # warnings as errors, sanitizers


def shared_files():
    """List (destination, files) of everything that goes to the package's share folder."""
    listed = [
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
    ]
    for top in SHARED_FOLDERS:
        for folder in sorted([Path(top), *Path(top).rglob('*/')]):
            files = sorted(str(file) for file in folder.glob('[!.]*') if file.is_file())
            if files and folder.name != '__pycache__':
                listed.append((f'share/{NAME}/{folder.as_posix()}', files))
    return listed


class Build(build_ext):
    """Compile the sources of the core at the same time."""

    def build_extensions(self):
        """Give each source to a thread, which waits for the compiler."""
        compile_all = self.compiler.compile

        def compile_each(sources, **options):
            with ThreadPool() as pool:
                return sum(pool.map(lambda source: compile_all([source], **options), sources, 1), [])

        self.compiler.compile = compile_each
        super().build_extensions()


setup(
    name=NAME,
    version='0.1.0',
    description='Find the physical parameters of ropes, cables, wires and hoses from observed manipulations',
    author='The dlo_calibration authors',
    maintainer='The dlo_calibration authors',
    maintainer_email='dlo_calibration@example.org',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', '**/*.pyi', 'files/schema/*.xsd', 'page/static/*', 'report/page.html']},
    data_files=shared_files(),
    cmdclass={'build_ext': Build},
    ext_modules=[Extension(
        f'{CORE}/_core'.replace('/', '.'), sorted(glob(f'{CORE}/**/*.cpp', recursive=True)),
        include_dirs=[CORE, *HEADERS], depends=['setup.py', *glob(f'{CORE}/**/*.hpp', recursive=True)],
        language='c++', extra_link_args=MORE_FLAGS, extra_compile_args=[
            '-std=c++17', '-O3', '-g0', '-fvisibility=hidden', '-Wno-psabi',
            # The same bits on every processor: no fused or reordered operations.
            '-ffp-contract=off', '-fno-math-errno', '-fno-trapping-math',
            # GCC 12 vectorizes to fused operations in spite of the above; lanes are vectors already, and what
            # Clang makes into vectors besides waits for memory.
            '-fno-tree-vectorize', '-fno-tree-slp-vectorize',
            *MORE_FLAGS])],
    zip_safe=False,
    python_requires='>=3.11',
    # The lower bounds are what Ubuntu 24.04 ships, so that a Jazzy machine keeps its own packages.
    install_requires=[
        'aiohttp>=3.9',
        'Jinja2>=3.1',
        'lxml>=5.2',
        'lz4>=4.0',
        'matplotlib>=3.6',
        'mcap>=1.6',
        'numpy>=1.26',
        'opencv-python-headless>=4.7',  # earlier ones of PyPI find no markers
        'pillow>=9.4',
        'pybullet>=3.2.5; python_version < "3.12"',  # for later ones PyPI has no binary
        'PyYAML>=6.0',
        'rich>=13.7',
        'rosbags>=0.11',
        'scipy>=1.11',
        'zstandard>=0.22',
    ],
    extras_require={
        # Where pip must compile it, which takes four minutes.
        'bullet': ['pybullet>=3.2.5'],
        'bench': [
            'mujoco>=3.2',
            'pytest>=7.4',
            'pytest-benchmark>=4.0',
        ],
        # For simulation on several machines.
        'distributed': ['distributed>=2023.12'],
        # On a machine with ROS 2 Jazzy these come from its own packages.
        'ros': [
            'ros-jazzy-common-interfaces',
            'ros-jazzy-rclpy',
            'ros-jazzy-rmw-fastrtps-cpp',
        ],
        # The search cma_es; rosdep has no key for it.
        'cma_es': ['cma>=4.0'],
        'test': [
            'axe-playwright-python>=0.1.4',
            'cma>=4.0',
            'colcon-core',
            'colcon-ros',
            'distributed>=2023.12',
            'hypothesis>=6.98',
            'mcap-ros2-support>=0.6',
            'mypy>=1.14',
            'playwright>=1.40',  # drives the machine's own Chromium
            'pybind11>=2.11',  # colcon builds without an environment of its own
            'pytest>=7.4',
            'pytest-benchmark>=4.0',
            'pytest-xdist>=3.5',
            'ruff>=0.6',
            'setuptools>=70.1,<80',  # builds wheels by itself; colcon knows none newer
        ],
    },
    entry_points={
        'console_scripts': [
            f'calibrator = {NAME}.ros.executable:calibrator',
            f'planner = {NAME}.ros.executable:planner',
            f'tracker = {NAME}.ros.executable:tracker',
            f'dlo-calibration = {NAME}.__main__:main',
        ],
    },
)
