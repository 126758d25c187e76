/* A control loop: the controller is asked every 2 ms of the game, here for the state in the middle of the start box. */
#include "hno_controller.h"

#include <stdio.h>

int main(void)
{
    const float theta[HNO_PLAYERS] = {@THETA@};
    const float x[HNO_PLAYERS * HNO_STATES] = {@STATE@};
    float u[HNO_PLAYERS * HNO_CONTROLS];
    hno_prepared prepared; /* again only when the types change */
    int code = hno_prepare(theta, &prepared);
    long steps = 0;

    for (float tau = HNO_HORIZON; code >= 0 && tau > 0; tau -= 0.002f, steps++) {
        code = hno_control(&prepared, tau, x, u); /* in a real loop: x is measured before, u is applied after */
        if (code < 0) break;                      /* u is what it was */
    }
    if (code < 0) {
        fprintf(stderr, "The controller refused with code %d.\n", code);
        return 1;
    }
    printf("%ld steps; controls of the last one:", steps);
    for (int k = 0; k < HNO_PLAYERS * HNO_CONTROLS; k++) printf(" %g", (double)u[k]);
    printf("\n");
    return 0;
}
