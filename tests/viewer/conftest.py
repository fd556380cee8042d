import pytest

import rgs_mi
from rgs_mi.core.scene_files import load_scene
from rgs_mi.viewer.subject import Subject

from windows import photographs, write_scene


@pytest.fixture(scope="package")
def scene_file(tmp_path_factory):
    """A scene of surfels, which no test changes."""
    rgs_mi.set_variant()
    return write_scene(tmp_path_factory.mktemp("scene"), diffuse="relightable")


@pytest.fixture(scope="package")
def subject(scene_file):
    """What there is to see of it, with photographs, which no test changes."""
    rgs_mi.set_variant()
    subject = Subject.of(load_scene(scene_file, {}), [scene_file.with_name("light.exr")])
    subject.compare_with(photographs(subject))
    return subject
