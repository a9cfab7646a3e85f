/* The stiff and extreme cases, as data: models, fields and views whose scales lie far apart, or that are hardly there
 * at all. Each must end in a right result or in one clear error: no NaN where there are heights, no bound that does not
 * hold, no memory beyond what was allowed. For `talus report` and for the tests. */
#ifndef CMD_REPORT_CASES_H
#define CMD_REPORT_CASES_H

#include "lib/talus.h"

typedef struct report_case {
    const char *group, *name;
    /* The model: 33 x 33 samples of gentle hills on cells of 10 m where nothing else is said. */
    int width, height;
    double (*z)(int i, int j);
    bool means; /* samples are means over cells, else heights at points */
    double quantum;
    const char *crs; /* NULL: not known */
    double x, y;     /* of the first sample */
    double cell_x, cell_y;
    /* The field: 2 levels where nothing else is said. */
    int levels;
    const char *scheme;
    double hurst, delta;               /* below 0: measured; 0 is 0, so that all rows give these */
    double hurst_map[2], delta_map[2]; /* from sample to sample in turn; both 0: no map */
    /* The view: none where fov is 0; straight down on the middle from `up` metres above the ground. */
    double fov, up, pixel_error;
    uint64_t budget;
    bool may_refuse; /* an error is an answer */
} report_case;

/* Ended by one without a name. */
extern const report_case report_cases[];

typedef enum case_end { CASE_RIGHT, CASE_REFUSED, CASE_FAILED } case_end;

typedef struct case_result {
    case_end end;
    char text[512];      /* the error, or what is wrong */
    double bound, found; /* of the framework, units of height */
    double low, high;    /* of the field */
    uint64_t samples;    /* of the field that were looked at */
    uint64_t triangles;  /* of the view */
    double seconds;
} case_result;

enum { CASE_MEMORY = 256 << 20 }; /* bytes that a case may take */

/* Depths at which the field in single precision is held against long double: at most REPORT_ROUNDING of delta apart. */
typedef struct report_depth {
    const char *name;
    tl_precision_options options;
} report_depth;

#define REPORT_ROUNDING 1e-5
/* Ended by one without a name. */
extern const report_depth report_depths[];

void report_run_case(const report_case *c, const tl_run *run, case_result *out);

#endif
