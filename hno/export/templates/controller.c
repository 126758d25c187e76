/* @ABOUT@
   C99, no heap, no global state: any number of threads may call it. Compile without -ffast-math, which knows no NaN. */
#include "hno_controller.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

@HELPERS@
@CONSTANTS@

static void prepare(const float *theta, hno_prepared *prepared)
{
@PREPARE@
}

static void control(const hno_prepared *prepared, float time, const float *x, float *out)
{
@CONTROL@
}

static void everything(const hno_prepared *prepared, float time, const float *x, hno_answer *answer)
{
@EVERYTHING@
}

static int all_finite(const float *entries, int count)
{
    for (int k = 0; k < count; k++)
        if (!isfinite(entries[k])) return 0;
    return 1;
}

static int question(const hno_prepared *prepared, float tau, const float *x)
{
    if (prepared == NULL || x == NULL) return HNO_ERROR_NULL;
    if (prepared->identity != HNO_IDENTITY) return HNO_ERROR_PREPARED;
    if (!isfinite(tau) || !all_finite(x, HNO_PLAYERS * HNO_STATES)) return HNO_ERROR_NOT_FINITE;
    if (tau < @EARLIEST@ || tau > @LATEST@) return HNO_ERROR_TAU;
    int code = prepared->warnings;
    for (int k = 0; k < HNO_PLAYERS * HNO_STATES; k++)
        if (x[k] < state_low[k] || x[k] > state_high[k]) code |= HNO_WARNING_STATE;
    return code;
}

static int answered(int code, const float *found, int count, float *out)
{
    if (!all_finite(found, count)) return HNO_ERROR_NOT_FINITE;
    memcpy(out, found, (size_t)count * sizeof(float));
    return code;
}

int hno_prepare(const float *theta, hno_prepared *prepared)
{
    if (theta == NULL || prepared == NULL) return HNO_ERROR_NULL;
    if (!all_finite(theta, HNO_PLAYERS)) return HNO_ERROR_NOT_FINITE;
    prepare(theta, prepared);
    prepared->identity = HNO_IDENTITY;
    prepared->warnings = 0;
    for (int k = 0; k < HNO_PLAYERS; k++)
        if (theta[k] < type_low[k] || theta[k] > type_high[k]) prepared->warnings = HNO_WARNING_TYPE;
    return prepared->warnings;
}

int hno_control(const hno_prepared *prepared, float tau, const float *x, float *u)
{
    float found[HNO_PLAYERS * HNO_CONTROLS];
    const int code = u == NULL ? HNO_ERROR_NULL : question(prepared, tau, x);
    if (code < 0) return code;
    control(prepared, tau, x, found);
    return answered(code, found, HNO_PLAYERS * HNO_CONTROLS, u);
}

int hno_everything(const hno_prepared *prepared, float tau, const float *x, hno_answer *answer)
{
    hno_answer found;
    const int code = answer == NULL ? HNO_ERROR_NULL : question(prepared, tau, x);
    if (code < 0) return code;
    everything(prepared, tau, x, &found);
    if (!all_finite(found.control, HNO_PLAYERS * HNO_CONTROLS)) return HNO_ERROR_NOT_FINITE;
    *answer = found;
    return code;
}

int hno_value(const hno_prepared *prepared, float tau, const float *x, float *value)
{
    hno_answer found;
    const int code = value == NULL ? HNO_ERROR_NULL : hno_everything(prepared, tau, x, &found);
    return code < 0 ? code : answered(code, found.@PLAYERS_VALUE@, HNO_PLAYERS, value);
}

int hno_costate(const hno_prepared *prepared, float tau, const float *x, float *costate)
{
    hno_answer found;
    const int code = costate == NULL ? HNO_ERROR_NULL : hno_everything(prepared, tau, x, &found);
    return code < 0 ? code : answered(code, found.costate, HNO_FUNCTIONS * HNO_PLAYERS * HNO_STATES, costate);
}

int hno_many_types(const hno_prepared *prepared, int count, float time, const float *x, float *value, float *costate,
                   float *u)
{
    if (count < 0) return HNO_ERROR_SIZE;
    int code = HNO_OK;
    for (int t = 0; t < count; t++) {
        const int one = question(prepared == NULL ? NULL : &prepared[t], time, x);
        if (one < 0) return one;
        code |= one;
    }
    if (count == 0) return code;
@MANY_SHARED@
    for (int t = 0; t < count; t++) {
        const hno_prepared *p = &prepared[t];
        (void)p;
@MANY_EACH@
    }
    return code;
}
