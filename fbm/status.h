/* What can go wrong in fbm. */
#ifndef FBM_STATUS_H
#define FBM_STATUS_H

typedef enum fbm_status {
    FBM_OK = 0,
    FBM_NO_MEMORY, /* the system refused memory */
    FBM_TOO_LARGE, /* the size is beyond what the function states */
} fbm_status;

#endif
