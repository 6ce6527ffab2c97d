"""The table of datasets: URLs, sizes, checksums, licences. Facts about the datasets, and nothing else.

Only the ETH Research Collection (EuRoC) publishes exact sizes and checksums, which a download is held to. The other
sizes are for people: what the dataset's page says, or what its server has sent to others; none where neither is known.
"""

from __future__ import annotations

from .dataset_types import Archive, Dataset, Part, Sequence

_MB = 10**6
_TUM = {
    "freiburg1": "xyz rpy 360 floor desk desk2 room plant teddy",
    "freiburg2": "xyz rpy 360_hemisphere 360_kidnap desk desk_with_person large_no_loop large_with_loop pioneer_360 "
    "pioneer_slam pioneer_slam2 pioneer_slam3 coke dishes flowerbouquet flowerbouquet_brownbackground "
    "metallic_sphere metallic_sphere2",
    "freiburg3": "long_office_household cabinet large_cabinet teddy sitting_static sitting_xyz sitting_halfsphere "
    "sitting_rpy walking_static walking_xyz walking_halfsphere walking_rpy nostructure_notexture_far "
    "nostructure_notexture_near_withloop nostructure_texture_far nostructure_texture_near_withloop "
    "structure_notexture_far structure_notexture_near structure_texture_far structure_texture_near",
}
_TUM_ABOUT = {
    "freiburg1_desk": 344 * _MB,
    "freiburg1_room": 830 * _MB,
    "freiburg1_xyz": 470 * _MB,
    "freiburg2_desk": 2010 * _MB,
    "freiburg3_long_office_household": 1484 * _MB,
}
_BONN = (
    "balloon balloon2 balloon_tracking balloon_tracking2 crowd crowd2 crowd3 kidnapping_box kidnapping_box2 "
    "moving_nonobstructing_box moving_nonobstructing_box2 moving_obstructing_box moving_obstructing_box2 "
    "person_tracking person_tracking2 placing_nonobstructing_box placing_nonobstructing_box2 "
    "placing_nonobstructing_box3 placing_obstructing_box removing_nonobstructing_box removing_nonobstructing_box2 "
    "removing_obstructing_box static static_close_far synchronous synchronous2"
)
_BONN_ABOUT = {
    "balloon": 244 * _MB,
    "person_tracking": 329 * _MB,
    "person_tracking2": 324 * _MB,
    "static_close_far": 1035 * _MB,
    "crowd2": 498 * _MB,
    "balloon_tracking": 326 * _MB,
    "balloon_tracking2": 236 * _MB,
    "moving_obstructing_box2": 422 * _MB,
    "balloon2": 267 * _MB,
    "moving_nonobstructing_box2": 513 * _MB,
}
# drives of 2011_09_26 that the dataset lists beside the others; all synced and rectified
_DRIVES = {
    "2011_09_26": "0001 0002 0005 0009 0011 0013 0014 0015 0017 0018 0019 0020 0022 0023 0027 0028 0029 0032 0035 0036 "
    "0039 0046 0048 0051 0052 0056 0057 0059 0060 0061 0064 0070 0079 0084 0086 0087 0091 0093 0095 0096 "
    "0101 0104 0106 0113 0117",
    "2011_09_30": "0016 0018 0020 0027 0028 0033 0034",
    "2011_10_03": "0027 0034 0042",
}
_SCENES = {
    "chess": (1, 2, 3, 4, 5, 6),
    "fire": (1, 2, 3, 4),
    "heads": (1, 2),
    "office": (1, 2, 3, 4, 5, 6, 7, 8, 9, 10),
    "pumpkin": (1, 2, 3, 6, 7, 8),
    "redkitchen": (1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 13, 14),
    "stairs": (1, 2, 3, 4, 5, 6),
}
_EUROC = {
    "machine_hall": (
        ("MH_01_easy", "MH_02_easy", "MH_03_medium", "MH_04_difficult", "MH_05_difficult"),
        Archive(
            "7b2419c1-62b5-4714-b7f8-485e5fe3e5fe/content",
            "machine_hall.zip",
            size_bytes=12_683_729_426,
            md5="363f5c2502b469cdd97ef85997714806",
        ),
    ),
    "vicon_room1": (
        ("V1_01_easy", "V1_02_medium", "V1_03_difficult"),
        Archive(
            "02ecda9a-298f-498b-970c-b7c44334d880/content",
            "vicon_room1.zip",
            size_bytes=6_042_263_426,
            md5="5ce06b405827e453a82523d3ca9c2fd0",
        ),
    ),
    "vicon_room2": (
        ("V2_01_easy", "V2_02_medium", "V2_03_difficult"),
        Archive(
            "ea12bc01-3677-4b4c-853d-87c7870b8c44/content",
            "vicon_room2.zip",
            size_bytes=6_013_384_949,
            md5="c6347f4e0476aaa9a43a919c163c49c5",
        ),
    ),
}
_REPLICA = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
_KITTI_ROOT = "https://s3.eu-central-1.amazonaws.com/avg-kitti"
_KITTI_LICENCE = "CC BY-NC-SA 3.0: non-commercial, share alike"
_KITTI_NOTE = "Its owners ask users to register at the page above."


def _tum() -> Dataset:
    names = [f"{camera}_{rest}" for camera, rests in _TUM.items() for rest in rests.split()]
    archives = {
        n: Archive(
            f"{n.partition('_')[0]}/rgbd_dataset_{n}.tgz",
            about_bytes=_TUM_ABOUT.get(n),
        )
        for n in names
    }
    return Dataset(
        "tum",
        "TUM RGB-D benchmark (Sturm et al., IROS 2012)",
        "https://cvg.cit.tum.de/rgbd/dataset",
        "https://cvg.cit.tum.de/data/datasets/rgbd-dataset",
        "CC BY 4.0",
        archives,
        {n: Sequence(n, f"rgbd_dataset_{n}", (Part(n),)) for n in names},
        prefix="rgbd_dataset_",
    )


def _bonn() -> Dataset:
    names = _BONN.split()
    return Dataset(
        "bonn",
        "Bonn RGB-D Dynamic dataset (Palazzolo et al., IROS 2019)",
        "https://www.ipb.uni-bonn.de/html/projects/rgbd_dynamic2019",
        "https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/",
        "not stated on its page; ask its authors before any use but research",
        {n: Archive(f"rgbd_bonn_{n}.zip", about_bytes=_BONN_ABOUT.get(n)) for n in names},
        {n: Sequence(n, f"rgbd_bonn_{n}", (Part(n),)) for n in names},
        prefix="rgbd_bonn_",
    )


def _kitti_raw() -> Dataset:
    archives = {f"{day}_calib": Archive(f"{day}_calib.zip") for day in _DRIVES}
    sequences = {}
    for day, numbers in _DRIVES.items():
        for name in (f"{day}_drive_{number}" for number in numbers.split()):
            archives[name] = Archive(f"{name}/{name}_sync.zip")
            # laser scans are most of an archive and no loader reads them
            wanted = tuple(f"{day}/{name}_sync/{what}" for what in ("image_00/", "image_02/", "oxts/"))
            sequences[name] = Sequence(name, f"{day}/{name}_sync", (Part(f"{day}_calib"), Part(name, wanted)))
    return Dataset(
        "kitti-raw",
        "KITTI raw, synced and rectified (Geiger et al., IJRR 2013): left cameras and OXTS",
        f"{_KITTI_ROOT}/raw_data",
        "https://www.cvlibs.net/datasets/kitti/raw_data.php",
        _KITTI_LICENCE,
        archives,
        sequences,
        _KITTI_NOTE,
    )


def _kitti_odometry(kind: str, about_bytes: int, camera: str, name: str, title: str) -> Dataset:
    sequences = {}
    for number in (f"{n:02d}" for n in range(22)):
        here = f"dataset/sequences/{number}/"
        images = Part(kind, (f"{here}{camera}/", f"{here}times.txt", f"{here}calib.txt"))
        poses = (Part("poses", (f"dataset/poses/{number}.txt",)),) if int(number) < 11 else ()
        sequences[number] = Sequence(number, here.rstrip("/"), (images, Part("calib", (here,)), *poses))
    return Dataset(
        name,
        f"KITTI odometry, {title} (Geiger et al., CVPR 2012)",
        _KITTI_ROOT,
        "https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
        _KITTI_LICENCE,
        {
            kind: Archive(f"data_odometry_{kind}.zip", about_bytes=about_bytes),
            "calib": Archive("data_odometry_calib.zip", about_bytes=1 * _MB),
            "poses": Archive("data_odometry_poses.zip", about_bytes=4 * _MB),
        },
        sequences,
        f"{_KITTI_NOTE} One archive holds all sequences.",
    )


def _seven_scenes() -> Dataset:
    sequences = {}
    for scene, numbers in _SCENES.items():
        for name in (f"{scene}/seq-{n:02d}" for n in numbers):
            sequences[name] = Sequence(name, name, (Part(scene, (f"{name}.zip",), nested=True),))
    return Dataset(
        "7scenes",
        "7-Scenes (Shotton et al., CVPR 2013)",
        "https://download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8",
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        "Microsoft's own, non-commercial research; see its page",
        {scene: Archive(f"{scene}.zip") for scene in _SCENES},
        sequences,
        "One archive holds a scene with all its sequences.",
    )


def _euroc() -> Dataset:
    sequences = {}
    for place, (names, _) in _EUROC.items():
        for name in names:
            part = Part(place, (f"{place}/{name}/{name}.zip",), nested=True)
            sequences[name] = Sequence(name, f"{place}/{name}", (part,))
    return Dataset(
        "euroc",
        "EuRoC MAV (Burri et al., IJRR 2016)",
        "https://www.research-collection.ethz.ch/server/api/core/bitstreams",
        "https://doi.org/10.3929/ethz-b-000690084",
        "in copyright, non-commercial use permitted",
        {place: archive for place, (_, archive) in _EUROC.items()},
        sequences,
        "One archive holds all sequences of a place.",
    )


def _replica() -> Dataset:
    return Dataset(
        "replica",
        "Replica as rendered for iMAP, published with NICE-SLAM (Straub et al., 2019; Zhu et al., CVPR 2022)",
        "https://cvg-data.inf.ethz.ch/nice-slam/data",
        "https://github.com/facebookresearch/Replica-Dataset",
        "Replica research terms, non-commercial; see its page",
        {"all": Archive("Replica.zip")},
        {
            n: Sequence(n, f"Replica/{n}", (Part("all", (f"Replica/{n}/", "Replica/cam_params.json")),))
            for n in _REPLICA
        },
        "One archive holds all scenes.",
    )


KNOWN: dict[str, Dataset] = {
    d.name: d
    for d in (
        _tum(),
        _bonn(),
        _kitti_raw(),
        _kitti_odometry("gray", 22_000 * _MB, "image_0", "kitti-odometry", "left grey camera"),
        _kitti_odometry("color", 65_000 * _MB, "image_2", "kitti-odometry-color", "left colour camera"),
        _seven_scenes(),
        _euroc(),
        _replica(),
    )
}
