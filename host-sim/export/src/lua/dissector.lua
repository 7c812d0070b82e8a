
-- From here on the same for every file. Above: ports[name] = { can = , formats = { indexes } }, formats and fields.

local p = Proto("rgw", "Recipe gateway frame")
local f_recipe = ProtoField.string("rgw.recipe", "Recipe")
local f_port = ProtoField.string("rgw.port", "Port")
local f_frame = ProtoField.string("rgw.frame", "Frame")
local f_checksum = ProtoField.bytes("rgw.checksum", "Checksum")
local own = { f_recipe, f_port, f_frame, f_checksum }
for _, field in ipairs(proto_fields) do own[#own + 1] = field end
p.fields = own
local e_none = ProtoExpert.new("rgw.no_frame", "No frame of this port", expert.group.MALFORMED, expert.severity.WARN)
p.experts = { e_none }

local interface = Field.new("frame.interface_name")
local direction = Field.new("frame.packet_flags_direction")
local can_id = Field.new("can.id")

-- The power of 256 that the byte at i counts, in a number of n bytes.
local function power(order, i, n)
  local behind = n - 1 - i
  if order == "L" then return i end
  if order == "B" then return behind end
  local at = order == "BS" and i or behind
  return at % 2 == 0 and at + 1 or at - 1
end

-- The bytes of a number, the lowest first.
local function bytes_of(tvb, at, n, order)
  local b = {}
  for i = 0, n - 1 do b[power(order, i, n)] = tvb(at + i, 1):uint() end
  return b
end

local function signed(value, bits)
  if value >= 2 ^ (bits - 1) then return value - 2 ^ bits end
  return value
end

local function number(field, tvb, at, n)
  local b = bytes_of(tvb, at, n, field.order)
  local kind = field.kind
  if kind == "f" then
    local text = ""
    for i = n - 1, 0, -1 do text = text .. string.char(b[i]) end
    return (Struct.unpack(n == 4 and ">f" or ">d", text))
  end
  if kind == "bits" then
    local value = 0
    for bit = 0, field.count - 1 do
      local place = field.first + bit
      if math.floor(b[math.floor(place / 8)] / 2 ^ (place % 8)) % 2 == 1 then value = value + 2 ^ bit end
    end
    return field.signed and signed(value, field.count) or value
  end
  local value = 0
  for i = 0, n - 1 do
    if kind == "bcd" then
      value = value + (math.floor(b[i] / 16) * 10 + b[i] % 16) * 100 ^ i
    else
      value = value + b[i] * 256 ^ i
    end
  end
  return field.signed and signed(value, 8 * n) or value
end

local function value_of(field, tvb, at, n)
  if field.kind == "text" then
    local text = tvb(at, n):raw()
    if field.fill then
      local fill = string.char(field.fill)
      while #text > 0 and text:sub(-1) == fill do text = text:sub(1, -2) end
    end
    return text
  end
  if field.kind == "dec" then return tonumber((tvb(at, n):raw():gsub("%s", ""))) end
  if field.kind == "hex" then return tonumber(tvb(at, n):raw(), 16) end
  return number(field, tvb, at, n)
end

-- Where the fields of a frame are; nothing if the bytes are not this frame.
local function places(format, tvb)
  local len, head, tail = tvb:len(), format.head, format.tail
  if len < format.shortest or len > format.longest then return nil end
  if len < #head + #tail then return nil end
  if #head > 0 and tvb(0, #head):raw() ~= head then return nil end
  if #tail > 0 and tvb(len - #tail, #tail):raw() ~= tail then return nil end
  local at, shared, found = #head, #head, {}
  for nth, field in ipairs(format.fields) do
    local start, n, more = at, field.len, 0
    if field.shared then
      start = shared
    elseif field.ends then
      local stop = start
      while stop < len and tvb(stop, 1):uint() ~= field.ends do stop = stop + 1 end
      if stop >= len then return nil end
      n, more = stop - start, 1
    elseif field.behind then
      n = len - field.behind - start
    end
    if n < 0 or start + n > len then return nil end
    if field.fixed and number(field, tvb, start, n) ~= field.fixed then return nil end
    found[nth] = { start, n }
    if not field.shared then
      shared = start
      at = start + n + more
    end
  end
  if at + #tail ~= len then return nil end
  return found
end

local function dissect(name, format, found, tvb, tree)
  local t = tree:add(p, tvb())
  if name then t:add(f_port, name):set_generated() end
  t:add(f_recipe, format.recipe):set_generated()
  t:add(f_frame, format.role):set_generated()
  for nth, field in ipairs(format.fields) do
    local start, n = found[nth][1], found[nth][2]
    local range = n > 0 and tvb(start, n) or nil
    if field.kind == "checksum" then
      t:add(f_checksum, range)
    elseif field.field and range then
      local value = value_of(field, tvb, start, n)
      local item
      if value == nil then
        t:add(range, field.name .. ": no number")
      else
        item = t:add(proto_fields[field.field], range, value)
        if field.use then item:append_text("  (" .. field.use .. ")") end
      end
    end
  end
  return t
end

function p.dissector(tvb, pinfo, tree)
  local iface, flags, id = interface(), direction(), can_id()
  local name = iface and tostring(iface) or nil
  local port = name and ports[name]
  pinfo.cols.protocol = "RGW"
  if name and not port and name:sub(1, 5) == "link " then
    pinfo.cols.info = name
    return Dissector.get("data"):call(tvb, pinfo, tree)
  end
  local candidates = port and port.formats or all_formats
  for _, nth in ipairs(candidates) do
    local format = formats[nth]
    local is_this = format.id == (id and id.value or nil)
    -- 1: received, 2: sent by the gateway.
    if is_this and port and flags and flags.value ~= 0 then is_this = flags.value == format.direction end
    local found = is_this and places(format, tvb)
    if found then
      dissect(port and name, format, found, tvb, tree)
      pinfo.cols.info = format.recipe .. " " .. format.role
      return tvb:len()
    end
  end
  local t = tree:add(p, tvb())
  if port then t:add(f_port, name):set_generated() end
  t:add_proto_expert_info(e_none)
  pinfo.cols.info = (name or "") .. " no frame of this port"
  return tvb:len()
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, p)
for table_name, ids in pairs({ ["can.id"] = standard_ids, ["can.extended_id"] = extended_ids }) do
  local ok, by_id = pcall(DissectorTable.get, table_name)
  if ok and by_id then
    for _, each in ipairs(ids) do by_id:add(each, p) end
  end
end
-- Older versions of Wireshark choose by hand only.
local ok, by_hand = pcall(DissectorTable.get, "can.subdissector")
if ok and by_hand then by_hand:add_for_decode_as(p) end
