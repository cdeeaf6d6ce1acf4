"""nuScenes (Caesar et al., CVPR 2020): its v1.0 tables and files, read where they are, without its devkit."""
