#include "dem/geographiclib.h"

#include <GeographicLib/Geocentric.hpp>
#include <GeographicLib/Geodesic.hpp>
#include <GeographicLib/LocalCartesian.hpp>
#include <GeographicLib/UTMUPS.hpp>

#include <cmath>
#include <limits>
#include <new>

static const double not_a_number = std::numeric_limits<double>::quiet_NaN();

double dem_geodesic_length(double semi_major, double flattening, double longitude1, double latitude1, double longitude2,
                           double latitude2)
{
    try {
        const GeographicLib::Geodesic geodesic(semi_major, flattening);
        double length = not_a_number;
        geodesic.Inverse(latitude1, longitude1, latitude2, longitude2, length);
        return length;
    } catch (...) {
        return not_a_number;
    }
}

void *dem_tangent_create(double semi_major, double flattening, double longitude, double latitude, double height)
{
    if (!(std::fabs(latitude) <= 90) || !std::isfinite(longitude) || !std::isfinite(height))
        return nullptr;
    try {
        return new GeographicLib::LocalCartesian(latitude, longitude, height,
                                                 GeographicLib::Geocentric(semi_major, flattening));
    } catch (...) {
        return nullptr;
    }
}

void dem_tangent_destroy(void *tangent)
{
    delete static_cast<GeographicLib::LocalCartesian *>(tangent);
}

void dem_tangent_forward(const void *tangent, double longitude, double latitude, double height, double xyz[3])
{
    try {
        static_cast<const GeographicLib::LocalCartesian *>(tangent)->Forward(latitude, longitude, height, xyz[0],
                                                                             xyz[1], xyz[2]);
    } catch (...) {
        xyz[0] = xyz[1] = xyz[2] = not_a_number;
    }
}

bool dem_utm_to_lonlat(int zone, bool north, double easting, double northing, double *longitude, double *latitude)
{
    try {
        GeographicLib::UTMUPS::Reverse(zone, north, easting, northing, *latitude, *longitude);
        return true;
    } catch (...) {
        return false;
    }
}
