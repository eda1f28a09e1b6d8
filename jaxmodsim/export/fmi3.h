/* The part of FMI 3.0 (fmi-standard.org) that fmi3.c implements: types, and declarations of all functions. */
#ifndef JAXMODSIM_FMI3_H
#define JAXMODSIM_FMI3_H
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if defined _WIN32 || defined __CYGWIN__
#define API __declspec(dllexport)
#elif defined __GNUC__
#define API __attribute__((visibility("default")))
#else
#define API
#endif

typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8, fmi3Byte;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean, fmi3Clock;
typedef const char *fmi3String;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef int fmi3DependencyKind, fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String category, fmi3String message);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64 time, fmi3Boolean canSet,
                                               fmi3Boolean canGet, fmi3Boolean stepFinished, fmi3Boolean canReturnEarly,
                                               fmi3Boolean *returnEarly, fmi3Float64 *returnTime);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);

#define REFERENCES const fmi3ValueReference references[], size_t nReferences
#define ACCESS(TYPE)                                                                              \
  API fmi3Status fmi3Get##TYPE(fmi3Instance, REFERENCES, fmi3##TYPE values[], size_t nValues);    \
  API fmi3Status fmi3Set##TYPE(fmi3Instance, REFERENCES, const fmi3##TYPE values[], size_t nValues)
ACCESS(Float32);
ACCESS(Float64);
ACCESS(Int8);
ACCESS(UInt8);
ACCESS(Int16);
ACCESS(UInt16);
ACCESS(Int32);
ACCESS(UInt32);
ACCESS(Int64);
ACCESS(UInt64);
ACCESS(Boolean);
ACCESS(String);
API fmi3Status fmi3GetBinary(fmi3Instance, REFERENCES, size_t sizes[], fmi3Binary values[], size_t nValues);
API fmi3Status fmi3SetBinary(fmi3Instance, REFERENCES, const size_t sizes[], const fmi3Binary values[], size_t nValues);
API fmi3Status fmi3GetClock(fmi3Instance, REFERENCES, fmi3Clock values[]);
API fmi3Status fmi3SetClock(fmi3Instance, REFERENCES, const fmi3Clock values[]);

API const char *fmi3GetVersion(void);
API fmi3Status fmi3SetDebugLogging(fmi3Instance, fmi3Boolean on, size_t nCategories, const fmi3String categories[]);
API fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                              fmi3Boolean visible, fmi3Boolean logs, fmi3InstanceEnvironment,
                                              fmi3LogMessageCallback);
API fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                             fmi3Boolean visible, fmi3Boolean logs, fmi3Boolean eventMode,
                                             fmi3Boolean earlyReturn, const fmi3ValueReference intermediate[],
                                             size_t nIntermediate, fmi3InstanceEnvironment, fmi3LogMessageCallback,
                                             fmi3IntermediateUpdateCallback);
API fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                                   fmi3Boolean visible, fmi3Boolean logs, fmi3InstanceEnvironment,
                                                   fmi3LogMessageCallback, fmi3ClockUpdateCallback,
                                                   fmi3LockPreemptionCallback, fmi3UnlockPreemptionCallback);
API void fmi3FreeInstance(fmi3Instance);
API fmi3Status fmi3EnterInitializationMode(fmi3Instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                           fmi3Float64 start, fmi3Boolean stopDefined, fmi3Float64 stop);
API fmi3Status fmi3ExitInitializationMode(fmi3Instance);
API fmi3Status fmi3EnterEventMode(fmi3Instance);
API fmi3Status fmi3Terminate(fmi3Instance);
API fmi3Status fmi3Reset(fmi3Instance);
API fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance, fmi3ValueReference, size_t *n);
API fmi3Status fmi3GetVariableDependencies(fmi3Instance, fmi3ValueReference, size_t indices[],
                                           fmi3ValueReference independents[], size_t elements[],
                                           fmi3DependencyKind kinds[], size_t n);
API fmi3Status fmi3GetFMUState(fmi3Instance, fmi3FMUState *);
API fmi3Status fmi3SetFMUState(fmi3Instance, fmi3FMUState);
API fmi3Status fmi3FreeFMUState(fmi3Instance, fmi3FMUState *);
API fmi3Status fmi3SerializedFMUStateSize(fmi3Instance, fmi3FMUState, size_t *size);
API fmi3Status fmi3SerializeFMUState(fmi3Instance, fmi3FMUState, fmi3Byte bytes[], size_t size);
API fmi3Status fmi3DeserializeFMUState(fmi3Instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *);
#define DERIVATIVE                                                                                      \
  fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,                         \
      const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,        \
      fmi3Float64 sensitivity[], size_t nSensitivity
API fmi3Status fmi3GetDirectionalDerivative(DERIVATIVE);
API fmi3Status fmi3GetAdjointDerivative(DERIVATIVE);
API fmi3Status fmi3EnterConfigurationMode(fmi3Instance);
API fmi3Status fmi3ExitConfigurationMode(fmi3Instance);
API fmi3Status fmi3GetIntervalDecimal(fmi3Instance, REFERENCES, fmi3Float64 intervals[], fmi3IntervalQualifier[]);
API fmi3Status fmi3GetIntervalFraction(fmi3Instance, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                       fmi3IntervalQualifier[]);
API fmi3Status fmi3GetShiftDecimal(fmi3Instance, REFERENCES, fmi3Float64 shifts[]);
API fmi3Status fmi3GetShiftFraction(fmi3Instance, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[]);
API fmi3Status fmi3SetIntervalDecimal(fmi3Instance, REFERENCES, const fmi3Float64 intervals[]);
API fmi3Status fmi3SetIntervalFraction(fmi3Instance, REFERENCES, const fmi3UInt64 counters[],
                                       const fmi3UInt64 resolutions[]);
API fmi3Status fmi3SetShiftDecimal(fmi3Instance, REFERENCES, const fmi3Float64 shifts[]);
API fmi3Status fmi3SetShiftFraction(fmi3Instance, REFERENCES, const fmi3UInt64 counters[],
                                    const fmi3UInt64 resolutions[]);
API fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance);
API fmi3Status fmi3UpdateDiscreteStates(fmi3Instance, fmi3Boolean *again, fmi3Boolean *terminate,
                                        fmi3Boolean *nominalsChanged, fmi3Boolean *statesChanged,
                                        fmi3Boolean *nextTimeDefined, fmi3Float64 *nextTime);
API fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance);
API fmi3Status fmi3CompletedIntegratorStep(fmi3Instance, fmi3Boolean noSetStateBefore, fmi3Boolean *enterEventMode,
                                           fmi3Boolean *terminate);
API fmi3Status fmi3SetTime(fmi3Instance, fmi3Float64 time);
API fmi3Status fmi3SetContinuousStates(fmi3Instance, const fmi3Float64 states[], size_t n);
API fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance, fmi3Float64 derivatives[], size_t n);
API fmi3Status fmi3GetEventIndicators(fmi3Instance, fmi3Float64 indicators[], size_t n);
API fmi3Status fmi3GetContinuousStates(fmi3Instance, fmi3Float64 states[], size_t n);
API fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance, fmi3Float64 nominals[], size_t n);
API fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance, size_t *n);
API fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance, size_t *n);
API fmi3Status fmi3EnterStepMode(fmi3Instance);
API fmi3Status fmi3GetOutputDerivatives(fmi3Instance, REFERENCES, const fmi3Int32 orders[], fmi3Float64 values[],
                                        size_t nValues);
API fmi3Status fmi3DoStep(fmi3Instance, fmi3Float64 time, fmi3Float64 length, fmi3Boolean noSetStateBefore,
                          fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached);
API fmi3Status fmi3ActivateModelPartition(fmi3Instance, fmi3ValueReference clock, fmi3Float64 time);
#endif
