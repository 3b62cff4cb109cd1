-- Asks for the addresses of a file, one after another; ends where ONCE is set and each was asked for.
local addresses, at = {}, 0
local once = os.getenv("ONCE") ~= nil

function init(args)
  addresses = {}
  for line in io.lines(os.getenv("ADDRESSES")) do
    addresses[#addresses + 1] = wrk.format("GET", line)
  end
end

function request()
  at = at + 1
  if at > #addresses then
    if once then wrk.thread:stop() end
    at = 1
  end
  return addresses[at]
end

function done(summary, latency)
  io.write(string.format("p50 %.2f ms, p99 %.2f ms, most %.2f ms; %d requests, %.0f requests/s, %d not 2xx\n",
    latency:percentile(50) / 1e3, latency:percentile(99) / 1e3, latency.max / 1e3, summary.requests,
    summary.requests / (summary.duration / 1e6), summary.errors.status))
end
