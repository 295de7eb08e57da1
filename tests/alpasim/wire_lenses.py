"""Messages of cameras with lenses that are no pinholes."""

from alpasim_plugin.log.wire import sensorsim_pb2
from tests.alpasim.service_cases import pinhole

Spec = sensorsim_pb2.CameraSpec


def distorted():
    spec = pinhole(320, 180)
    p = spec.opencv_pinhole_param
    p.focal_length_x, p.focal_length_y, p.principal_point_x = 200, 210, 150
    p.radial_coeffs.extend([-0.25, 0.08, 0.01, 0.02, 0.0, 0.0])
    p.tangential_coeffs.extend([0.002, -0.003])
    p.thin_prism_coeffs.extend([0.001, 0.0, -0.001, 0.0])
    return spec


def fisheye():
    p = sensorsim_pb2.OpenCVFisheyeCameraParam(
        principal_point_x=160, principal_point_y=90, focal_length_x=200, focal_length_y=190
    )
    p.radial_coeffs.extend([0.02, -0.01, 0.003, 0.0])
    return Spec(opencv_fisheye_param=p, resolution_w=320, resolution_h=180, logical_id="c")


def ftheta(backward):
    p = sensorsim_pb2.FthetaCameraParam(principal_point_x=165, principal_point_y=88)
    if backward:
        p.reference_poly = sensorsim_pb2.FthetaCameraParam.PIXELDIST_TO_ANGLE
        p.pixeldist_to_angle_poly.extend([0.0, 1 / 190, 0.0, 1e-9])
    else:
        p.reference_poly = sensorsim_pb2.FthetaCameraParam.ANGLE_TO_PIXELDIST
        p.angle_to_pixeldist_poly.extend([0.0, 190.0, 0.0, -6.0])
    p.linear_cde.linear_c, p.linear_cde.linear_d, p.linear_cde.linear_e = 1.01, 0.002, -0.001
    return Spec(ftheta_param=p, resolution_w=320, resolution_h=180, logical_id="c")
