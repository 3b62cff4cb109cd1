-- Asks for the addresses of a file, one after another; ends where ONCE is set and each was asked for.
local ffi = require("ffi")
ffi.cdef("typedef struct { long s; long us; } timeval; int gettimeofday(timeval *, void *);")

local addresses, at = {}, 0
local once = os.getenv("ONCE") ~= nil
local threads = {}

local function now()
  local time = ffi.new("timeval")
  ffi.C.gettimeofday(time, nil)
  return tonumber(time.s) + tonumber(time.us) / 1e6
end

function setup(thread)
  threads[#threads + 1] = thread
end

function init(args)
  addresses = {}
  for line in io.lines(os.getenv("ADDRESSES")) do
    addresses[#addresses + 1] = wrk.format("GET", line)
  end
end

function request()
  at = at + 1
  if at == 1 then began = now() end
  if at > #addresses then
    if once then
      -- wrk itself waits until its time is over.
      ended = ended or now()
      wrk.thread:stop()
    end
    at = 2
  end
  return addresses[at]
end

function done(summary, latency)
  local seconds = summary.duration / 1e6
  for _, thread in ipairs(threads) do
    local from, to = thread:get("began"), thread:get("ended")
    if from and to then seconds = to - from end
  end
  io.write(string.format("p50 %.2f ms, p99 %.2f ms, most %.2f ms; %d requests in %.2f s, %.0f requests/s, %d not 2xx\n",
    latency:percentile(50) / 1e3, latency:percentile(99) / 1e3, latency.max / 1e3, summary.requests, seconds,
    summary.requests / seconds, summary.errors.status))
end
