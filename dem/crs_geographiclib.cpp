#include "dem/geographiclib.h"

#include <GeographicLib/AlbersEqualArea.hpp>
#include <GeographicLib/Geocentric.hpp>
#include <GeographicLib/Geodesic.hpp>
#include <GeographicLib/LambertConformalConic.hpp>
#include <GeographicLib/LocalCartesian.hpp>
#include <GeographicLib/PolarStereographic.hpp>
#include <GeographicLib/TransverseMercator.hpp>
#include <GeographicLib/TransverseMercatorExact.hpp>
#include <GeographicLib/UTMUPS.hpp>

#include <cmath>
#include <limits>
#include <memory>
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

/* ---- Maps ---- */

/* A projection without its false origin: metres from the natural one. */
struct dem_map {
    dem_map_definition definition;
    double x0 = 0, y0 = 0; /* of the origin */

    explicit dem_map(const dem_map_definition &d) : definition(d)
    {
    }
    virtual ~dem_map() = default;
    virtual void forward(double longitude, double latitude, double &x, double &y) const = 0;
    virtual void reverse(double x, double y, double &longitude, double &latitude) const = 0;
};

namespace
{

/* The series is good to nanometres within 3900 km of the central meridian of the Earth; beyond it the exact formulas
 * are taken, which are for oblate ellipsoids. For a sphere the series is exact everywhere. */
class transverse_mercator : public dem_map
{
    GeographicLib::TransverseMercator series;
    std::unique_ptr<GeographicLib::TransverseMercatorExact> exact;
    double reach;

  public:
    explicit transverse_mercator(const dem_map_definition &d)
        : dem_map(d), series(d.semi_major, d.flattening, d.scale), reach(0.61 * d.semi_major * d.scale)
    {
        if (d.flattening > 0)
            exact.reset(new GeographicLib::TransverseMercatorExact(d.semi_major, d.flattening, d.scale));
    }

    void forward(double longitude, double latitude, double &x, double &y) const override
    {
        series.Forward(definition.longitude, latitude, longitude, x, y);
        if (exact && !(std::fabs(x) < reach))
            exact->Forward(definition.longitude, latitude, longitude, x, y);
    }

    void reverse(double x, double y, double &longitude, double &latitude) const override
    {
        if (std::fabs(x) < reach) {
            series.Reverse(definition.longitude, x, y, latitude, longitude);
            return;
        }
        /* far from the meridian not every point is an image */
        double back_x, back_y;
        if (exact)
            exact->Reverse(definition.longitude, x, y, latitude, longitude);
        else
            series.Reverse(definition.longitude, x, y, latitude, longitude);
        forward(longitude, latitude, back_x, back_y);
        if (!(std::fabs(back_x - x) < 1e-3 && std::fabs(back_y - y) < 1e-3))
            longitude = latitude = not_a_number;
    }
};

class conformal_conic : public dem_map
{
    GeographicLib::LambertConformalConic conic;

  public:
    conformal_conic(const dem_map_definition &d, double parallel1, double parallel2)
        : dem_map(d), conic(d.semi_major, d.flattening, parallel1, parallel2, d.scale)
    {
    }

    void forward(double longitude, double latitude, double &x, double &y) const override
    {
        conic.Forward(definition.longitude, latitude, longitude, x, y);
    }

    void reverse(double x, double y, double &longitude, double &latitude) const override
    {
        conic.Reverse(definition.longitude, x, y, latitude, longitude);
    }
};

/* Southern cones are mirrored: AlbersEqualArea::Forward of GeographicLib 2.1 is wrong on them (its Reverse is not). */
class albers : public dem_map
{
    double sign;
    GeographicLib::AlbersEqualArea conic;

  public:
    explicit albers(const dem_map_definition &d)
        : dem_map(d), sign(d.parallels[0] + d.parallels[1] < 0 ? -1 : 1),
          conic(d.semi_major, d.flattening, sign * d.parallels[0], sign * d.parallels[1], d.scale)
    {
    }

    void forward(double longitude, double latitude, double &x, double &y) const override
    {
        conic.Forward(definition.longitude, sign * latitude, longitude, x, y);
        y *= sign;
    }

    void reverse(double x, double y, double &longitude, double &latitude) const override
    {
        conic.Reverse(definition.longitude, x, sign * y, latitude, longitude);
        latitude *= sign;
        /* what lies outside of the ring that is the image comes back as a pole */
        if (std::fabs(latitude) < 89.9999)
            return;
        double back_x, back_y;
        forward(longitude, latitude, back_x, back_y);
        if (!(std::hypot(back_x - x, back_y - y) < 1e-3))
            longitude = latitude = not_a_number;
    }
};

class polar_stereographic : public dem_map
{
    GeographicLib::PolarStereographic polar;
    bool north;

  public:
    explicit polar_stereographic(const dem_map_definition &d)
        : dem_map(d), polar(d.semi_major, d.flattening, 1), north(d.parallels[0] > 0)
    {
        polar.SetScale(std::fabs(d.parallels[0]), d.scale);
    }

    void forward(double longitude, double latitude, double &x, double &y) const override
    {
        polar.Forward(north, latitude, longitude - definition.longitude, x, y);
    }

    void reverse(double x, double y, double &longitude, double &latitude) const override
    {
        polar.Reverse(north, x, y, latitude, longitude);
        longitude += definition.longitude;
    }
};

class web_mercator : public dem_map
{
  public:
    using dem_map::dem_map;

    void forward(double longitude, double latitude, double &x, double &y) const override
    {
        const double degree = GeographicLib::Math::degree();
        x = definition.semi_major * GeographicLib::Math::AngDiff(definition.longitude, longitude) * degree;
        y = std::fabs(latitude) < 90 ? definition.semi_major * std::asinh(std::tan(latitude * degree)) : not_a_number;
    }

    void reverse(double x, double y, double &longitude, double &latitude) const override
    {
        const double degree = GeographicLib::Math::degree();
        longitude = definition.longitude + x / definition.semi_major / degree;
        latitude = std::atan(std::sinh(y / definition.semi_major)) / degree;
    }
};

dem_map *new_map(const dem_map_definition &d)
{
    switch (d.kind) {
    case DEM_MAP_TRANSVERSE_MERCATOR:
        return new transverse_mercator(d);
    case DEM_MAP_CONFORMAL_CONIC:
        return new conformal_conic(d, d.parallels[0], d.parallels[1]);
    case DEM_MAP_ALBERS:
        return new albers(d);
    case DEM_MAP_POLAR_STEREOGRAPHIC:
        return new polar_stereographic(d);
    case DEM_MAP_MERCATOR: /* the conic whose parallels are opposite */
        return new conformal_conic(d, d.parallels[0], -d.parallels[0]);
    case DEM_MAP_WEB_MERCATOR:
        return new web_mercator(d);
    }
    return nullptr;
}

double normalized(double longitude)
{
    return std::fabs(longitude) <= 180 ? longitude : GeographicLib::Math::AngNormalize(longitude);
}

/* Both coordinates or none. */
void keep_finite(double &x, double &y)
{
    if (!std::isfinite(x) || !std::isfinite(y))
        x = y = not_a_number;
}

} // namespace

dem_map *dem_map_create(const dem_map_definition *definition)
{
    try {
        std::unique_ptr<dem_map> map(new_map(*definition));
        if (map)
            map->forward(definition->longitude, definition->latitude, map->x0, map->y0);
        return map && std::isfinite(map->x0) && std::isfinite(map->y0) ? map.release() : nullptr;
    } catch (...) {
        return nullptr;
    }
}

void dem_map_destroy(dem_map *map)
{
    delete map;
}

void dem_map_to_lonlat(const dem_map *map, size_t n, double *x, double *y)
{
    const dem_map_definition &d = map->definition;
    for (size_t k = 0; k < n; k++) {
        double longitude = not_a_number, latitude = not_a_number;
        double from_x = x[k] * d.unit - d.easting + map->x0, from_y = y[k] * d.unit - d.northing + map->y0;
        try {
            if (std::isfinite(from_x) && std::isfinite(from_y))
                map->reverse(from_x, from_y, longitude, latitude);
        } catch (...) {
            longitude = not_a_number;
        }
        x[k] = normalized(longitude);
        y[k] = latitude;
        keep_finite(x[k], y[k]);
    }
}

void dem_map_from_lonlat(const dem_map *map, size_t n, double *longitude, double *latitude)
{
    const dem_map_definition &d = map->definition;
    for (size_t k = 0; k < n; k++) {
        double x = not_a_number, y = not_a_number;
        try {
            if (std::fabs(latitude[k]) <= 90 && std::isfinite(longitude[k]))
                map->forward(longitude[k], latitude[k], x, y);
        } catch (...) {
            x = not_a_number;
        }
        longitude[k] = (x - map->x0 + d.easting) / d.unit;
        latitude[k] = (y - map->y0 + d.northing) / d.unit;
        keep_finite(longitude[k], latitude[k]);
    }
}
