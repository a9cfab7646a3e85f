/* Writers of characteristic points. */
#ifndef OUT_POINTS_H
#define OUT_POINTS_H

#include "dem/framework.h"
#include "lib/base/output.h"
#include "lib/talus.h"

typedef tl_status out_points_writer(const tl_framework *framework, const tl_source *dem, tl_output *output,
                                    const tl_points_options *options, tl_error *error);

out_points_writer out_points_geojson, out_points_csv, out_points_ply, out_points_geotiff;

#endif
